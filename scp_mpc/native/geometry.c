/* Signed distance to the no-go set of one obstacle at one node, its half-space, its curvature and
 * the risk that it leaves: scp_mpc/geometry/ellipsoid.py, inflation.py, tangent_basis.py, risk.py.
 *
 * Notation:
 *     y, n        offset from the mean and unit outward normal, in the ellipsoid's axes
 *     R, sigma    eigenvectors of the covariance in columns, standard deviations along them
 *     e, r        semi-axes, sum of the radii
 *     sd          signed distance, max over unit n of n'y - |diag(e) n|
 *
 *     exact   g = sd(y; s sigma) - r
 *     axes    g = c (|y / (s sigma + r)| - 1), c the shortest semi-axis at s_ref
 *     polytopes, whatever the inflation:  g = sd(p - mu) - s max sigma - r
 */
#include <float.h>

#include "core.h"
#include "small.h"

static const int MOST_STEPS = 30;
static const double CLOSE = 1e-6; /* |w|^2 - 1 from which one more step reaches rounding */
static const double MOST_CURVED = 0.75; /* no step is longer than four of Newton's */
static const double TINY = 1e-13; /* relative; a coordinate or semi-axis below it is zero */
static const double LEAST = 1e-70; /* [m] the same absolutely: its fourth power is a number */
static const double POINT = 1e-9;       /* [m] a semi-axis below this is that of a point */
static const double CENTRE = 1e-12;     /* in semi-axes: nearer to the mean than that is at it */
static const double LEAST_RISK = 1e-12; /* smaller risks are not told apart: s stays below 7.04 */
static const int MOST_RISK_NEWTON = 20;
static const double CLOSE_SIZE = 1e-9;  /* change of a size that ends them */
static const double MOST_SIZE = 1e3;
static const double TOUCH = 1e-6;       /* [m] a certified plan may be so deep in what is certain */
static const double ROOT_HALF = 0.70710678118654752440, ROOT_TWO_PI = 2.50662827463100050242;

static inline double product_length(const int d, const double *a, const double *b)
{
    double sum = 0.0;
    for (int l = 0; l < d; l++)
        sum += (a[l] * b[l]) * (a[l] * b[l]);
    return sqrt(sum);
}

/* ---- signed distance */

/* The maximiser n: n_l is proportional to y_l / (t + e_l^2), where t solves |w(t)| = 1 with
 * w_l = e_l y_l / (t + e_l^2). 1/|w| is concave and almost linear (More and Sorensen, 1983):
 * Halley's method on 1/|w| = 1 takes two or three steps from a lower bound, what one coordinate
 * alone asks for. Vanishing coordinates take the sign of `side`, NULL for the positive orthant. */
static inline void nearest_normal(const int d, const double *y, const double *semi_axes,
                                  const double *side, double *n)
{
    double z[3], ez2[3], gap[3], farthest = 0.0, start = -INFINITY;
    for (int l = 0; l < d; l++)
        farthest = larger(fabs(y[l]), farthest);
    const double tiny = larger(TINY * (farthest + greatest(d, semi_axes)), LEAST);
    const double shortest = larger(smallest(d, semi_axes), tiny), least = shortest * shortest;
    for (int l = 0; l < d; l++) {
        const double e = larger(semi_axes[l], tiny);
        z[l] = fabs(y[l]) >= tiny ? y[l] : side && side[l] < 0 ? -tiny : tiny;
        gap[l] = e * e - least; /* tau = t + least keeps the smallest denominator exact */
        const double ez = e * fabs(z[l]);
        ez2[l] = ez * ez;
        start = larger(ez - gap[l], start);
    }
    double tau = start;
    for (int k = 0; k < MOST_STEPS; k++) {
        double norm2 = 0.0, descent = 0.0, bend = 0.0;
        for (int l = 0; l < d; l++) {
            const double inverse = 1.0 / (tau + gap[l]), w2 = ez2[l] * inverse * inverse;
            norm2 += w2;
            descent += w2 * inverse;
            bend += w2 * inverse * inverse;
        }
        const double beyond = sqrt(norm2) - 1.0, square = descent * descent;
        const double curved = 1.5 * beyond * (bend * norm2 - square); /* 0: Newton's method */
        tau += beyond * norm2 * descent / (square - lesser(curved, MOST_CURVED * square));
        tau = larger(tau, start);
        if (!(fabs(norm2 - 1.0) >= CLOSE))
            break;
    }
    for (int l = 0; l < d; l++)
        n[l] = z[l] / (tau + gap[l]);
    const double length = sqrt(inner(d, n, n));
    for (int l = 0; l < d; l++)
        n[l] /= length;
}

double signed_distance(int d, const double *y, const double *semi_axes, const double *side,
                       double *n)
{
    if (d == 2)
        nearest_normal(2, y, semi_axes, side, n);
    else
        nearest_normal(3, y, semi_axes, side, n);
    return inner(d, n, y) - product_length(d, semi_axes, n); /* no unit n gives more */
}

/* ---- no-go sets */

/* The signs that LAPACK gives eigenvectors in the plane: at a mean without any motion they are all
 * that tells one side from the other. */
static void sign_like_lapack(const double *A, double *R)
{
    if (fabs(A[1]) <= 0.5 * DBL_EPSILON * sqrt(fabs(A[0])) * sqrt(fabs(A[3])))
        return;
    R[0] = -R[0], R[2] = -R[2];
    if (A[0] > A[3])
        R[1] = -R[1], R[3] = -R[3];
}

void no_go_of(const scp_core *core, const step *at, int j, int node, no_go *set)
{
    const int d = core->at.d, C = at->nodes.size;
    const int pair = j * C + node, here = j * (C + 1) + node + 1;
    double *rotation = at->rotation + pair * d * d, *deviation = at->deviation + pair * d;
    if (!at->decomposed[pair]) {
        eigen_small(d, at->covariances + here * d * d, deviation, rotation);
        if (d == 2)
            sign_like_lapack(at->covariances + here * d * d, rotation);
        for (int l = 0; l < d; l++)
            deviation[l] = sqrt(larger(deviation[l], 0.0));
        at->decomposed[pair] = 1;
    }
    set->mean = at->means + here * d;
    set->rotation = rotation;
    set->deviation = deviation;
    set->radius = at->radii[pair];
    set->body = at->has_shapes && at->shape[j] >= 0 ? core->solids + at->shape[j] : NULL;
}

/* sd is jointly convex in (p, s): the half-space is inside the true feasible set. */
static inline double linearise_exact(const int d, const no_go *set, const double *position,
                                     double s, const double *before, double *a)
{
    double offset[3], y[3] = {0}, side[3] = {0}, e[3] = {0}, n[3];
    difference(d, position, set->mean, offset);
    to_eigenframe(d, set->rotation, offset, y);
    to_eigenframe(d, set->rotation, before, side);
    for (int l = 0; l < d; l++)
        e[l] = s * set->deviation[l];
    nearest_normal(d, y, e, side, n);
    to_world(d, set->rotation, n, a);
    const double width = product_length(d, set->deviation, n);
    a[d] = -width;
    return inner(d, n, y) - s * width - set->radius;
}

static double axes_scale(const scp_core *core, const no_go *set)
{
    return larger(core->p.s_ref * smallest(core->at.d, set->deviation) + set->radius, POINT);
}

/* At the mean w has no direction: a short one towards `before`, else along the first axis. */
static void leave_centre(int d, const no_go *set, const double *before, const double *e, double *w)
{
    to_eigenframe(d, set->rotation, before, w);
    for (int l = 0; l < d; l++)
        w[l] /= e[l];
    const double length = sqrt(inner(d, w, w));
    for (int l = 0; l < d; l++)
        w[l] = CENTRE * (length > 0 ? w[l] / length : l == 0);
}

/* The norm, not its square, whose tangent stands too far out. */
static inline double linearise_axes(const int d, const scp_core *core, const no_go *set,
                                    const double *position, double s, const double *before,
                                    double *a)
{
    double offset[3], w[3], e[3], gradient[3], farthest = 0.0;
    difference(d, position, set->mean, offset);
    to_eigenframe(d, set->rotation, offset, w);
    for (int l = 0; l < d; l++) {
        e[l] = larger(s * set->deviation[l] + set->radius, POINT);
        w[l] /= e[l];
        farthest = larger(farthest, fabs(w[l]));
    }
    if (farthest < CENTRE)
        leave_centre(d, set, before, e, w);
    const double scale = axes_scale(core, set), norm = sqrt(inner(d, w, w));
    a[d] = 0.0;
    for (int l = 0; l < d; l++) {
        gradient[l] = scale * w[l] / (norm * e[l]);
        a[d] -= gradient[l] * w[l] * set->deviation[l];
    }
    to_world(d, set->rotation, gradient, a);
    return scale * (norm - 1.0);
}

double linearise_no_go(const scp_core *core, const no_go *set, const double *position, double s,
                       const double *before, double *a, double *bend)
{
    const int d = core->at.d;
    if (set->body) {
        double y[3];
        difference(d, position, set->mean, y);
        a[d] = -greatest(d, set->deviation);
        return solid_distance(d, set->body, y, before, a, bend) + s * a[d] - set->radius;
    }
    if (core->p.inflation == SCP_AXES)
        return d == 2 ? linearise_axes(2, core, set, position, s, before, a)
                      : linearise_axes(3, core, set, position, s, before, a);
    return d == 2 ? linearise_exact(2, set, position, s, before, a)
                  : linearise_exact(3, set, position, s, before, a);
}

/* ---- curvature */

void tangents(int d, const double *n, double *T)
{
    if (d == 2) {
        T[0] = -n[1], T[1] = n[0];
        return;
    }
    /* The first columns of the reflection that takes n onto -+ the last axis. */
    const double mirror[3] = {n[0], n[1], n[2] + (n[2] < 0 ? -1.0 : 1.0)};
    const double share = 2.0 / inner(3, mirror, mirror);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 2; k++)
            T[i * 2 + k] = (i == k) - share * mirror[i] * mirror[k];
}

/* C with C C' = M^-1, whose eigenvalues count as no less than POINT; M is (k, k), k = 1 or 2. */
static void inverse_root(int k, const double *M, double *C)
{
    if (k == 1) {
        C[0] = 1.0 / sqrt(larger(M[0], POINT));
        return;
    }
    double values[2];
    eigen_small(2, M, values, C);
    for (int l = 0; l < 4; l++)
        C[l] /= sqrt(larger(values[l & 1], POINT));
}

/* From y = grad h(n) + sd n with the support function h(n) = s |diag(sigma) n|: on the tangent
 * space T of n, dn = M^-1 (T'dy - T'(dh_n/ds) ds) with M = T' h_nn T + sd. */
static inline void curvature_exact(const int d, const no_go *set, double s, double g,
                                   const double *a, double *L)
{
    const int k = d - 1;
    double n[3] = {0}, pull[3], T[6], M[4], root[4], half[6], pulled[2];
    const double width = larger(-a[d], POINT), sd = larger(g + set->radius, POINT);
    to_eigenframe(d, set->rotation, a, n);
    tangents(d, n, T);
    for (int l = 0; l < d; l++)
        pull[l] = set->deviation[l] * set->deviation[l] * n[l] / width;
    times(1, d, k, pull, T, pulled);
    for (int i = 0; i < k; i++)
        for (int j = 0; j < k; j++) {
            double wide = 0.0;
            for (int l = 0; l < d; l++)
                wide += set->deviation[l] * T[l * k + i] * (set->deviation[l] * T[l * k + j]);
            M[i * k + j] = s / width * (wide - pulled[i] * pulled[j]) + (i == j ? sd : 0.0);
        }
    inverse_root(k, M, root);
    times(d, k, k, T, root, half);
    for (int l = 0; l < d; l++)
        pull[l] = -pull[l];
    times(d, d, k, set->rotation, half, L);
    times(1, d, k, pull, half, L + d * k);
}

/* The change of w with s alone is left out: g is not convex in it. */
static inline void curvature_axes(const int d, const scp_core *core, const no_go *set, double s,
                                  double g, const double *a, double *L)
{
    const int k = d - 1;
    double direction[3], e[3], across[3], T[6];
    const double scale = axes_scale(core, set), norm = larger(g / scale + 1.0, CENTRE);
    to_eigenframe(d, set->rotation, a, direction);
    for (int l = 0; l < d; l++) {
        e[l] = larger(s * set->deviation[l] + set->radius, POINT);
        direction[l] *= e[l];
    }
    const double length = sqrt(inner(d, direction, direction)), stretch = sqrt(scale / norm);
    for (int l = 0; l < d; l++) {
        direction[l] /= length;
        across[l] = -norm * direction[l] * set->deviation[l];
    }
    tangents(d, direction, T);
    for (int l = 0; l < d * k; l++)
        T[l] *= stretch / e[l / k];
    times(d, d, k, set->rotation, T, L);
    times(1, d, k, across, T, L + d * k);
}

void no_go_curvature(const scp_core *core, const no_go *set, double s, double g, const double *a,
                     const double *bend, double *L)
{
    const int d = core->at.d, k = d - 1;
    if (set->body) { /* s moves its faces without turning them */
        memcpy(L, bend, (size_t)(d * k) * sizeof *L);
        for (int l = 0; l < k; l++)
            L[d * k + l] = 0.0;
    } else if (core->p.inflation == SCP_AXES) {
        if (d == 2)
            curvature_axes(2, core, set, s, g, a, L);
        else
            curvature_axes(3, core, set, s, g, a, L);
    } else if (d == 2) {
        curvature_exact(2, set, s, g, a, L);
    } else {
        curvature_exact(3, set, s, g, a, L);
    }
}

/* ---- risk: what a half-space at s standard deviations promises, and the other way round */

static double tail(double s) { return 0.5 * erfc(s * ROOT_HALF); } /* Phi(-s) */

/* Standard deviations that fit into the room: all or none where there is no deviation. */
static double sizes_in(double room, double width)
{
    return width > 0 ? room / width : room >= -TOUCH ? INFINITY : -INFINITY;
}

/* The best half-space is tangent to the largest ellipsoid (+) ball that leaves the position
 * outside: its size solves sd(y; s sigma) = r, by Newton's method from s = 0. sd is convex and
 * falls with s: each step ends short of the root, and its half-space is a bound by itself. */
static inline double ellipsoid_risk(const int d, const no_go *set, const double *position)
{
    double offset[3], y[3], e[3], n[3], s = 0.0, bound = -INFINITY;
    difference(d, position, set->mean, offset);
    to_eigenframe(d, set->rotation, offset, y);
    for (int k = 0; k < MOST_RISK_NEWTON; k++) {
        for (int l = 0; l < d; l++)
            e[l] = s * set->deviation[l];
        nearest_normal(d, y, e, NULL, n);
        const double width = product_length(d, set->deviation, n);
        const double reached = sizes_in(inner(d, n, y) - set->radius, width);
        const int better = reached > bound + CLOSE_SIZE;
        bound = larger(bound, reached);
        if (!better)
            break;
        s = lesser(larger(bound, 0.0), MOST_SIZE);
    }
    return tail(bound);
}

double risk_of(const scp_core *core, const no_go *set, const double *position)
{
    const int d = core->at.d;
    if (!set->body)
        return d == 2 ? ellipsoid_risk(2, set, position) : ellipsoid_risk(3, set, position);
    double y[3] = {0};
    difference(d, position, set->mean, y);
    const double room = solid_distance(d, set->body, y, NULL, NULL, NULL) - set->radius;
    return tail(sizes_in(room, greatest(d, set->deviation)));
}

/* Phi^-1(1 - risk): a rational start (Abramowitz and Stegun, 26.2.23, wrong by 4.5e-4), then
 * Halley's method twice, for risks up to one half. Near that it is erf that does not cancel. */
double size_at_risk(double risk)
{
    if (!(risk < 1.0))
        return risk == 1.0 ? -INFINITY : NAN;
    const double q = risk > 0.5 ? 1.0 - risk : larger(risk, LEAST_RISK), t = sqrt(-2.0 * log(q));
    double s = t - (2.515517 + t * (0.802853 + t * 0.010328)) /
                       (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)));
    for (int k = 0; k < 2; k++) {
        const double miss = q > 0.25 ? 0.5 - q - 0.5 * erf(s * ROOT_HALF) : tail(s) - q;
        const double newton = miss * ROOT_TWO_PI * exp(0.5 * s * s);
        s += newton / (1.0 - 0.5 * s * newton);
    }
    return risk > 0.5 ? -s : s;
}
