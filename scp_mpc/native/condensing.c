/* Condensing: the dynamics eliminated, in coordinates in which the cost is a circle;
 * scp/condensing.py, and layout.py's outputs and responses.
 *
 * Constraints act on the outputs y of a plan only. Every plan that obeys the dynamics, linearised
 * about the present plan where they are nonlinear, is
 *
 *     y = y_free + S v,        cost = least + |v|^2 / 2
 *
 * where y_free is the plan that nothing constrains. Python takes v from a Cholesky factor of the
 * dense Hessian. Here it comes from a Riccati pass: with P the cost to go and
 *
 *     M = 2 R + B'P B = T^-1 T^-T,    K = M^-1 B'P A,    v_i = T^-T (du_i + K de),
 *
 * which is the same up to a rotation, takes O(N) for a plan and O(N^2) for S, and is causal: v_i acts
 * on interval i and later ones only.
 *
 * Plans are always rolled out, so that there are no defects. Rolling out is Newton's method on all
 * stages at once, x <- x + D^-1 (f(x, u) - x_next), which for a linear robot takes one step.
 *
 *     e       (N, nx) deviations x_i - xref_i, i = 1 .. N; de, du changes of deviations and inputs
 *     D       block bidiagonal, unit diagonal, -A below:  D e = B u + drift
 *     C_k, D_k    derivatives of a position between two samples with respect to x_i and u_i
 *
 * Source: Bertsekas, Dynamic Programming and Optimal Control I, 4.1.
 */
#include <float.h>

#include "core.h"

enum { ROUNDS = 4 };                               /* of Newton's method, before stage by stage */
static const double CLOSED = 1e-12;                /* defect that is none */
static const double ROUNDINGS = 4 * DBL_EPSILON;   /* likewise, of the largest state */
static const double ridges[] = {0, 1e-14, 1e-12, 1e-10}; /* of the Hessian, of its largest diagonal */

/* ---- memory */

static int between(const scp_core *core) /* m: coordinates between two samples */
{
    return core->at.nodes.size * core->at.d / core->at.N - core->at.nodes.n * core->at.d;
}

static void lay_out_derivatives(const scp_core *core, arena *from, derivatives *D)
{
    size_t N = (size_t)core->at.N, nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    size_t m = (size_t)between(core);
    D->A = doubles(from, N * nx * nx);
    D->B = doubles(from, N * nx * nu);
    D->C = doubles(from, N * m * nx);
    D->D = doubles(from, N * m * nu);
    D->at = doubles(from, N * (size_t)(core->at.nodes.n * core->at.d) * nx);
}

void lay_out_sensitivity(const scp_core *core, arena *from, sensitivity *by)
{
    size_t N = (size_t)core->at.N, nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    by->K = doubles(from, N * nu * nx);
    by->T = doubles(from, N * nu * nu);
    by->A = doubles(from, N * nx * nx);
    by->E = doubles(from, N * nx * N * nu);
    by->S = doubles(from, (size_t)core->at.ny * (size_t)core->at.nv);
}

void lay_out_condensing(scp_core *core, arena *from)
{
    core->reach = ints(from, (size_t)core->at.ny);
    if (!core->linear)
        return;
    lay_out_derivatives(core, from, &core->always);
    lay_out_sensitivity(core, from, &core->always_by);
    core->drift = doubles(from, (size_t)(core->at.N * core->at.nx));
}

void lay_out_nominal(const scp_core *core, arena *from, nominal *n)
{
    const layout *at = &core->at;
    size_t states = (size_t)(at->N * at->nx), d = (size_t)at->d, most = (size_t)at->most_pairs;
    n->y = n->planes.y = doubles(from, (size_t)at->ny);
    n->roll.u = doubles(from, (size_t)at->n);
    n->roll.e = doubles(from, states);
    n->roll.p = doubles(from, (size_t)at->nodes.size * d);
    if (core->linear)
        n->roll.along = core->always;
    else
        lay_out_derivatives(core, from, &n->roll.along);
    n->costates = doubles(from, states);
    n->reaction = doubles(from, (size_t)at->nf);
    n->pairs.obstacle = ints(from, most);
    n->pairs.node = ints(from, most);
    n->pairs.near = bytes(from, most);
    n->planes.g = doubles(from, most);
    n->planes.a = doubles(from, most * (d + 1));
    n->planes.bend = doubles(from, most * d * (d - 1));
    n->force = doubles(from, most);
    n->slack = doubles(from, most);
    n->excess = doubles(from, (size_t)(at->N * at->nb));
}

void lay_out_iterate(const scp_core *core, arena *from, scp_iterate *it)
{
    const layout *at = &core->at;
    size_t nx = (size_t)at->nx, n = (size_t)at->n, M = (size_t)at->M;
    it->states = doubles(from, (size_t)(at->N + 1) * nx);
    it->inputs = doubles(from, n);
    it->s = doubles(from, M);
    it->slack = doubles(from, (size_t)at->most_pairs);
    it->dynamics = doubles(from, (size_t)at->N * nx);
    it->input_bounds = doubles(from, n);
    it->margin = doubles(from, M);
    it->obstacles = doubles(from, (size_t)at->most_pairs);
    it->pins = doubles(from, (size_t)at->most_pairs);
    it->state_bounds = doubles(from, (size_t)(at->N * at->nb));
    it->rates = doubles(from, n);
}

void lay_out_result(const scp_core *core, arena *from, result *r)
{
    lay_out_iterate(core, from, &r->it);
    lay_out_nominal(core, from, &r->at);
}

/* ---- copies; onto itself is allowed */

static void copy(int count, const double *from, double *to)
{
    if (from != to)
        memcpy(to, from, (size_t)count * sizeof(double));
}

static void copy_derivatives(const scp_core *core, const derivatives *from, derivatives *to)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu, m = between(core);
    copy(N * nx * nx, from->A, to->A);
    copy(N * nx * nu, from->B, to->B);
    copy(N * m * nx, from->C, to->C);
    copy(N * m * nu, from->D, to->D);
    copy(N * core->at.nodes.n * core->at.d * nx, from->at, to->at);
}

void copy_nominal(const scp_core *core, const nominal *from, nominal *to)
{
    const layout *at = &core->at;
    int count = from->pairs.count, d = at->d;
    if (from == to)
        return;
    copy(at->ny, from->y, to->y);
    copy(at->n, from->roll.u, to->roll.u);
    copy(at->N * at->nx, from->roll.e, to->roll.e);
    copy(at->nodes.size * d, from->roll.p, to->roll.p);
    if (core->linear)
        to->roll.along = from->roll.along;
    else
        copy_derivatives(core, &from->roll.along, &to->roll.along);
    copy(at->N * at->nx, from->costates, to->costates);
    copy(at->nf, from->reaction, to->reaction);
    to->pairs.count = count;
    memcpy(to->pairs.obstacle, from->pairs.obstacle, (size_t)count * sizeof(int));
    memcpy(to->pairs.node, from->pairs.node, (size_t)count * sizeof(int));
    memcpy(to->pairs.near, from->pairs.near, (size_t)at->most_pairs);
    copy(count, from->planes.g, to->planes.g);
    copy(count * (d + 1), from->planes.a, to->planes.a);
    copy(count * d * (d - 1), from->planes.bend, to->planes.bend);
    copy(count, from->force, to->force);
    copy(count, from->slack, to->slack);
    copy(at->N * at->nb, from->excess, to->excess);
    to->cost = from->cost;
    to->kkt = from->kkt;
}

void copy_iterate(const scp_core *core, const scp_iterate *from, scp_iterate *to)
{
    const layout *at = &core->at;
    copy((at->N + 1) * at->nx, from->states, to->states);
    copy(at->n, from->inputs, to->inputs);
    copy(at->M, from->s, to->s);
    copy(at->most_pairs, from->slack, to->slack);
    to->has_multipliers = from->has_multipliers;
    if (!from->has_multipliers)
        return;
    copy(at->N * at->nx, from->dynamics, to->dynamics);
    copy(at->n, from->input_bounds, to->input_bounds);
    copy(at->M, from->margin, to->margin);
    copy(at->most_pairs, from->obstacles, to->obstacles);
    copy(at->most_pairs, from->pins, to->pins);
    copy(at->N * at->nb, from->state_bounds, to->state_bounds);
    copy(at->rated, from->rates, to->rates);
}

void copy_result(const scp_core *core, const result *from, result *to)
{
    if (from == to)
        return;
    copy_iterate(core, &from->it, &to->it);
    to->cost = from->cost;
    to->merit = from->merit;
    to->kkt = from->kkt;
    to->status = from->status;
    to->iterations = from->iterations;
    to->there = from->there;
    to->has_nominal = from->has_nominal;
    if (from->has_nominal)
        copy_nominal(core, &from->at, &to->at);
}

/* ---- small products: y += A x and y += A'x, with A (m, n) */

static void add(int m, int n, const double *restrict A, const double *restrict x, double *restrict y)
{
    for (int i = 0; i < m; i++, A += n) {
        double sum = 0;
        for (int j = 0; j < n; j++)
            sum += A[j] * x[j];
        y[i] += sum;
    }
}

static void add_t(int m, int n, const double *restrict A, const double *restrict x,
                  double *restrict y)
{
    for (int i = 0; i < m; i++, A += n)
        for (int j = 0; j < n; j++)
            y[j] += A[j] * x[i];
}

void derivatives_roll(const scp_core *core, const derivatives *D, double *e)
{
    int nx = core->at.nx;
    for (int i = 1; i < core->at.N; i++)
        add(nx, nx, D->A + i * nx * nx, e + (i - 1) * nx, e + i * nx);
}

void derivatives_costates(const scp_core *core, const derivatives *D, double *nu)
{
    int nx = core->at.nx;
    for (int i = core->at.N - 1; i > 0; i--)
        add_t(nx, nx, D->A + i * nx * nx, nu + i * nx, nu + (i - 1) * nx);
}

/* Coordinates (C, d) that go with de and du, to first order. */
static void moved(const scp_core *core, const derivatives *D, const double *de, const double *du,
                  double *dp)
{
    int nx = core->at.nx, nu = core->at.nu, m = between(core);
    int part = core->at.nodes.n * core->at.d;
    memset(dp, 0, (size_t)(core->at.nodes.size * core->at.d) * sizeof(double));
    for (int i = 0; i < core->at.N; i++, dp += m + part) {
        if (m && i)
            add(m, nx, D->C + i * m * nx, de + (i - 1) * nx, dp);
        if (m)
            add(m, nu, D->D + i * m * nu, du + i * nu, dp);
        add(part, nx, D->at + i * part * nx, de + i * nx, dp + m);
    }
}

/* ---- outputs */

/* y (ny,); no last input counts as zero. */
static void write_outputs(const scp_core *core, const double *p, const double *s, const double *u,
                          const double *u_last, const double *e, double *y)
{
    const layout *at = &core->at;
    copy(at->nodes.size * at->d, p, y + at->p);
    copy(at->M, s, y + at->s);
    copy(at->n, u, y + at->u);
    for (int i = 0; i < at->rated; i++) {
        double before = i >= at->nu ? u[i - at->nu] : u_last ? u_last[i] : 0;
        y[at->du + i] = u[i] - before;
    }
    double *z = y + at->z;
    memset(z, 0, (size_t)(at->N * at->nb) * sizeof(double));
    for (int i = 0; i < at->N && at->nb; i++, z += at->nb)
        add(at->nb, at->nx, core->p.row, e + i * at->nx, z);
}

void outputs_of(const scp_core *core, const double *p, const double *s, const double *u,
                const double *e, double *y)
{
    write_outputs(core, p, s, u, core->now->u_last, e, y);
}

/* ---- the Riccati pass */

/* T = L^-1 of M = L L'; 0 if M is positive definite. */
static int inverse_root(int n, double *M, double *T)
{
    if (n == 2) {
        double a = M[0], b = M[2] / a, c = M[3] - b * M[2];
        if (!(a > 0 && c > 0 && a <= DBL_MAX && c <= DBL_MAX))
            return 1;
        a = 1 / sqrt(a), c = 1 / sqrt(c);
        T[0] = a, T[1] = 0, T[2] = -b * c, T[3] = c;
        return 0;
    }
    if (cholesky(n, M))
        return 1;
    invert_lower(n, M, T);
    return 0;
}

/* What a pass takes from scratch: P (nx, nx), P A (nx, nx), P B (nx, nu), M (nu, nu), B'P A and
 * T B'P A (nu, nx). */
typedef struct {
    double *P, *PA, *PB, *M, *BPA, *W;
} ahead;

static ahead ahead_of(scp_core *core)
{
    arena *room = &core->scratch;
    size_t nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    ahead a;
    a.P = doubles(room, nx * nx);
    a.PA = doubles(room, nx * nx);
    a.PB = doubles(room, nx * nu);
    a.M = doubles(room, nu * nu);
    a.BPA = doubles(room, nu * nx);
    a.W = doubles(room, nu * nx);
    return a;
}

/* C = A B and C = A'B for small ones. */
static inline void multiply(int m, int k, int n, const double *restrict A, const double *restrict B,
                            double *restrict C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++)
                sum += A[i * k + l] * B[l * n + j];
            C[i * n + j] = sum;
        }
}

static inline void multiply_t(int k, int m, int n, const double *restrict A,
                              const double *restrict B, double *restrict C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++)
                sum += A[l * m + i] * B[l * n + j];
            C[i * n + j] = sum;
        }
}

/* One interval backwards: K and T, and P <- 2 Q + A'P A - W'W, W = T B'P A. */
static inline int one_back(const scp_core *core, int nx, int nu, const double *A, const double *B,
                           double ridge, ahead *a, double *K, double *T)
{
    multiply(nx, nx, nu, a->P, B, a->PB);
    multiply(nx, nx, nx, a->P, A, a->PA);
    multiply_t(nx, nu, nu, B, a->PB, a->M);
    for (int i = 0; i < nu * nu; i++)
        a->M[i] += 2 * core->p.R[i];
    for (int i = 0; i < nu; i++)
        a->M[i * nu + i] += ridge;
    if (inverse_root(nu, a->M, T))
        return 1;
    multiply_t(nx, nu, nx, B, a->PA, a->BPA);
    multiply(nu, nu, nx, T, a->BPA, a->W);
    multiply_t(nu, nu, nx, T, a->W, K);
    for (int i = 0; i < nx; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 2 * core->p.Q[i * nx + j];
            for (int l = 0; l < nx; l++)
                sum += A[l * nx + i] * a->PA[l * nx + j];
            for (int l = 0; l < nu; l++)
                sum -= a->W[l * nx + i] * a->W[l * nx + j];
            a->P[i * nx + j] = a->P[j * nx + i] = sum;
        }
    return 0;
}

/* K and T along derivatives, the Hessian's diagonal raised; 0, or it is not positive definite. */
static int gains(scp_core *core, const double *A, const double *B, double ridge, double *K,
                 double *T, double *costs)
{
    int nx = core->at.nx, nu = core->at.nu, failed = 0;
    size_t used = core->scratch.used;
    ahead a = ahead_of(core);
    for (int i = 0; i < nx * nx; i++)
        a.P[i] = 2 * core->p.Qf[i];
    for (int i = core->at.N - 1; i >= 0 && !failed; i--) {
        const double *Ai = A + i * nx * nx, *Bi = B + i * nx * nu;
        double *Ki = K + i * nu * nx, *Ti = T + i * nu * nu;
        if (costs)
            copy(nx * nx, a.P, costs + i * nx * nx);
        if (nx == 4 && nu == 2) /* constants, for the compiler */
            failed = one_back(core, 4, 2, Ai, Bi, ridge, &a, Ki, Ti);
        else if (nx == 5 && nu == 2)
            failed = one_back(core, 5, 2, Ai, Bi, ridge, &a, Ki, Ti);
        else
            failed = one_back(core, nx, nu, Ai, Bi, ridge, &a, Ki, Ti);
    }
    core->scratch.used = used;
    return failed;
}

/* Largest diagonal entry of the Hessian 2 (R + G'Q G). */
static double largest_diagonal(scp_core *core, const double *A, const double *B)
{
    int nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    ahead a = ahead_of(core);
    double most = 0;
    for (int i = 0; i < nx * nx; i++)
        a.P[i] = 2 * core->p.Qf[i];
    for (int i = core->at.N - 1; i >= 0; i--) {
        multiply(nx, nx, nu, a.P, B + i * nx * nu, a.PB);
        multiply_t(nx, nu, nu, B + i * nx * nu, a.PB, a.M);
        for (int k = 0; k < nu; k++)
            most = fmax(most, a.M[k * nu + k] + 2 * core->p.R[k * nu + k]);
        multiply(nx, nx, nx, a.P, A + i * nx * nx, a.PA);
        multiply_t(nx, nx, nx, A + i * nx * nx, a.PA, a.P);
        for (int k = 0; k < nx * nx; k++)
            a.P[k] += 2 * core->p.Q[k];
    }
    core->scratch.used = used;
    return most;
}

/* Gains; with a ridge where rounding ate what is definite. 0, or the derivatives are no numbers.
 * `costs` (N, nx, nx), P after each interval, may be NULL. */
static int riccati(scp_core *core, const double *A, const double *B, double *K, double *T,
                   double *costs)
{
    int failed = gains(core, A, B, 0, K, T, costs);
    double most = failed ? largest_diagonal(core, A, B) : 0;
    for (size_t k = 1; k < sizeof ridges / sizeof ridges[0] && failed; k++)
        failed = gains(core, A, B, ridges[k] * most, K, T, costs);
    return failed;
}

/* ---- responses */

/* y (w,) += sum of k rows, `apart`, times coefficients, `stride`: four at a time */
static void sum_rows(int k, int w, const double *c, int stride, const double *X, int apart,
                     double *restrict y)
{
    for (; k >= 4; k -= 4, c += 4 * stride, X += 4 * apart) {
        const double *x1 = X + apart, *x2 = x1 + apart, *x3 = x2 + apart;
        double c0 = c[0], c1 = c[stride], c2 = c[2 * stride], c3 = c[3 * stride];
        for (int l = 0; l < w; l++)
            y[l] += (c0 * X[l] + c1 * x1[l]) + (c2 * x2[l] + c3 * x3[l]);
    }
    for (; k > 0; k--, c += stride, X += apart)
        axpy(w, c[0], X, y);
}

/* Likewise, of few that are not zero. */
static void sum_some(int k, int w, const double *c, const double *X, int apart, double *y)
{
    for (int j = 0; j < k; j++)
        if (c[j] != 0)
            axpy(w, c[j], X + j * apart, y);
}

/* The closed loop A - B K, E, and rows u of S:
 *     e_i = (A - B K) e_before + B T'v_i,    u_i = T'v_i - K e_before */
static void respond_states(const scp_core *core, const derivatives *D, sensitivity *by)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, n = at->n, nv = at->nv;
    for (int i = 0; i < at->N; i++) {
        const double *B = D->B + i * nx * nu, *K = by->K + i * nu * nx, *T = by->T + i * nu * nu;
        double *closed = by->A + i * nx * nx, *E = by->E + i * nx * n;
        const double *before = i ? E - nx * n : E;
        double *U = by->S + (at->u + i * nu) * nv;
        int w = i * nu;
        for (int r = 0; r < nu; r++) {
            memset(U + r * nv, 0, (size_t)nv * sizeof(double));
            if (i)
                sum_rows(nx, w, K + r * nx, 1, before, n, U + r * nv);
            scale(w, -1, U + r * nv);
            for (int c = r; c < nu; c++)
                U[r * nv + w + c] = T[c * nu + r];
        }
        for (int r = 0; r < nx; r++) {
            for (int c = 0; c < nx; c++) {
                closed[r * nx + c] = D->A[(i * nx + r) * nx + c];
                for (int k = 0; k < nu; k++)
                    closed[r * nx + c] -= B[r * nu + k] * K[k * nx + c];
            }
            memset(E + r * n, 0, (size_t)n * sizeof(double));
            if (i)
                sum_rows(nx, w, closed + r * nx, 1, before, n, E + r * n);
            for (int c = 0; c < nu; c++)
                E[r * n + w + c] = dot(c + 1, B + r * nu, T + c * nu);
        }
    }
}

/* Rows of S for positions, changes and bounded states. */
static void respond_outputs(const scp_core *core, const derivatives *D, sensitivity *by)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, n = at->n, nv = at->nv, m = between(core);
    int part = at->nodes.n * at->d;
    double *p = by->S + at->p * nv, *du = by->S + at->du * nv, *z = by->S + at->z * nv;
    memset(p, 0, (size_t)at->u * (size_t)nv * sizeof(double)); /* and rows of sizes */
    memset(du, 0, (size_t)(at->ny - at->du) * (size_t)nv * sizeof(double));
    for (int i = 0; i < at->N; i++) {
        const double *E = by->E + i * nx * n, *U = by->S + (at->u + i * nu) * nv;
        int w = (i + 1) * nu;
        for (int r = 0; r < m; r++, p += nv) {
            if (i)
                sum_some(nx, w - nu, D->C + (i * m + r) * nx, E - nx * n, n, p);
            sum_some(nu, w, D->D + (i * m + r) * nu, U, nv, p);
        }
        for (int r = 0; r < part; r++, p += nv)
            sum_some(nx, w, D->at + (i * part + r) * nx, E, n, p);
        for (int r = 0; r < at->nb; r++, z += nv)
            sum_some(nx, w, core->p.row + r * nx, E, n, z);
        for (int k = 0; at->rated && k < nu; k++, du += nv) {
            copy(w, U + k * nv, du);
            if (i)
                axpy(w - nu, -1, U + (k - nu) * nv, du);
        }
    }
    for (int j = 0; j < at->moving; j++)
        by->S[(at->s + j) * nv + n + j] = 1 / sqrt(2 * core->p.s_weight);
}

static int sensitivity_along(scp_core *core, const derivatives *D, sensitivity *by)
{
    if (riccati(core, D->A, D->B, by->K, by->T, NULL))
        return 1;
    respond_states(core, D, by);
    respond_outputs(core, D, by);
    return 0;
}

/* de and du of v (n,), or of -v. */
static void respond(const scp_core *core, const derivatives *D, const sensitivity *by,
                    const double *v, double sign, double *de, double *du)
{
    int nx = core->at.nx, nu = core->at.nu;
    memset(de, 0, (size_t)(core->at.N * nx) * sizeof(double));
    for (int i = 0; i < core->at.N; i++, v += nu, du += nu, de += nx) {
        const double *K = by->K + i * nu * nx, *T = by->T + i * nu * nu;
        for (int k = 0; k < nu; k++) {
            double sum = 0;
            for (int r = k; r < nu; r++)
                sum += T[r * nu + k] * v[r];
            du[k] = sign * sum;
            for (int c = 0; i && c < nx; c++)
                du[k] -= K[k * nx + c] * de[c - nx];
        }
        if (i)
            add(nx, nx, D->A + i * nx * nx, de - nx, de);
        add(nx, nu, D->B + i * nx * nu, du, de);
    }
}

/* Backwards through the closed loop: with F_x and F_u the gradients of all columns' stages in e and
 * u, and `later` those of all that comes after in e_i,
 *     rows v_i = T F_u + T B'later,    later <- F_x - K'F_u + (A - B K)'later */
void curvature_in_v(scp_core *core, const sensitivity *by, const double *stages, const double *sway,
                    double *W)
{
    const layout *at = &core->at;
    int N = at->N, nx = at->nx, nu = at->nu, n = at->n, nv = at->nv, size = nx + nu;
    size_t used = core->scratch.used, block = (size_t)(nx * n);
    double *later = doubles(&core->scratch, block), *sooner = doubles(&core->scratch, block);
    double *F = doubles(&core->scratch, (size_t)(size * n)), *F_u = F + nx * n;
    memset(later, 0, block * sizeof(double));
    memset(W, 0, (size_t)nv * (size_t)nv * sizeof(double));
    for (int i = N - 1; i >= 0; i--) {
        const double *H = stages + i * size * size, *K = by->K + i * nu * nx;
        const double *T = by->T + i * nu * nu, *E = by->E + i * nx * n;
        const double *U = by->S + (at->u + i * nu) * nv, *before = i ? E - nx * n : E;
        int w = (i + 1) * nu, heading = core->p.heading;
        if (sway)
            axpy(w, sway[i], E + heading * n, later + heading * n);
        memset(F, 0, (size_t)(size * n) * sizeof(double));
        for (int r = i ? 0 : nx; r < size; r++) {
            if (i)
                sum_some(nx, w - nu, H + r * size, before, n, F + r * n);
            sum_some(nu, w, H + r * size + nx, U, nv, F + r * n);
        }
        for (int k = 0; k < nu; k++) {
            double *row = W + (i * nu + k) * nv;
            sum_rows(k + 1, w, T + k * nu, 1, F_u, n, row);
            sum_rows(nx, w, E + i * nu + k, n, later, n, row);
            for (int c = 0; c < i * nu + k; c++)
                W[c * nv + i * nu + k] = row[c];
        }
        scale(nu * n, -1, F_u);
        for (int c = 0; i && c < nx; c++) {
            double *row = sooner + c * n;
            copy(w - nu, F + c * n, row);
            sum_rows(nu, w - nu, K + c, nx, F_u, n, row);
            sum_rows(nx, w - nu, by->A + i * nx * nx + c, nx, later, n, row);
        }
        double *swap = later;
        later = sooner, sooner = swap;
    }
    core->scratch.used = used;
}

/* ---- set-up and steps */

void set_up_condensing(scp_core *core)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu;
    for (int k = 0; k < at->nodes.size * at->d; k++)
        core->reach[at->p + k] = (k / at->d / at->nodes.count + 1) * nu;
    for (int j = 0; j < at->M; j++)
        core->reach[at->s + j] = 0;
    for (int k = 0; k < at->n; k++)
        core->reach[at->u + k] = (k / nu + 1) * nu;
    for (int k = 0; k < at->rated; k++)
        core->reach[at->du + k] = (k / nu + 1) * nu;
    for (int k = 0; k < at->N * at->nb; k++)
        core->reach[at->z + k] = (k / at->nb + 1) * nu;
    if (!core->linear)
        return;
    size_t used = core->scratch.used;
    double *X = doubles(&core->scratch, (size_t)((at->N + 1) * nx));
    double *p = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    memset(X, 0, (size_t)((at->N + 1) * nx) * sizeof(double));
    double *U = doubles(&core->scratch, (size_t)at->n);
    memset(U, 0, (size_t)at->n * sizeof(double));
    for (int i = 0; i < at->N; i++) {
        copy(nx * nx, core->p.A, core->always.A + i * nx * nx);
        copy(nx * nu, core->p.B, core->always.B + i * nx * nu);
    }
    nodes_derivatives(core, at->nodes, X, U, p, &core->always);
    core->broken = sensitivity_along(core, &core->always, &core->always_by);
    core->scratch.used = used;
}

void begin_condensing(scp_core *core)
{
    int nx = core->at.nx;
    const double *x_ref = core->now->x_ref;
    for (int i = 0; core->linear && i < core->at.N; i++) {
        double *drift = core->drift + i * nx;
        for (int k = 0; k < nx; k++)
            drift[k] = -x_ref[(i + 1) * nx + k];
        add(nx, nx, core->p.A, i ? x_ref + i * nx : core->now->x0, drift);
    }
}

/* Close the defects of states X (N+1, nx) in place, A and B along them; 0 if that succeeds. */
static int closed(scp_core *core, double *X, const double *U, double *after, rollout *roll)
{
    int N = core->at.N, nx = core->at.nx;
    double before = HUGE_VAL;
    for (int round = 0; round < ROUNDS; round++) {
        if (model_linearise(core, N, X, U, 1.0, after, roll->along.A, roll->along.B))
            return 1;
        for (int k = 0; k < N * nx; k++)
            after[k] -= X[nx + k];
        double worst = largest_abs(N * nx, after);
        if (worst <= CLOSED + ROUNDINGS * largest_abs((N + 1) * nx, X))
            return 0;
        if (!(worst < before)) /* or NaN */
            return 1;
        before = worst;
        derivatives_roll(core, &roll->along, after);
        axpy(N * nx, 1, after, X + nx);
    }
    return 1;
}

/* Walk through the stages one by one. */
static int walked(scp_core *core, double *X, const double *U, double *after, rollout *roll)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu, failed = 0;
    for (int i = 0; i < N && !failed; i++)
        failed = model_step(core, X + i * nx, U + i * nu, X + (i + 1) * nx);
    return failed || model_linearise(core, N, X, U, 1.0, after, roll->along.A, roll->along.B);
}

int roll_out(scp_core *core, const double *U, const double *guess_e, rollout *roll)
{
    const layout *at = &core->at;
    const double *x_ref = core->now->x_ref, *x0 = core->now->x0;
    int N = at->N, nx = at->nx, nu = at->nu, failed = 0;
    size_t used = core->scratch.used;
    double *X = doubles(&core->scratch, (size_t)((N + 1) * nx));
    double *after = doubles(&core->scratch, (size_t)(N * nx)), *e = roll->e;
    copy(at->n, U, roll->u);
    copy(nx, x0, X);
    if (core->linear) {
        roll->along = core->always;
        copy(N * nx, core->drift, e);
        for (int i = 0; i < N; i++) {
            if (i)
                add(nx, nx, core->p.A, e + (i - 1) * nx, e + i * nx);
            add(nx, nu, core->p.B, U + i * nu, e + i * nx);
        }
        for (int k = 0; k < N * nx; k++)
            X[nx + k] = x_ref[nx + k] + e[k];
        nodes_positions(core, at->nodes, X, U, roll->p);
    } else {
        for (int k = 0; guess_e && k < N * nx; k++)
            X[nx + k] = x_ref[nx + k] + guess_e[k];
        if (!guess_e || closed(core, X, U, after, roll))
            failed = walked(core, X, U, after, roll);
        failed = failed || nodes_derivatives(core, at->nodes, X, U, roll->p, &roll->along);
        for (int k = 0; k < N * nx; k++)
            e[k] = failed ? (double)NAN : X[nx + k] - x_ref[nx + k];
    }
    for (int k = 0; k < at->nodes.size; k++)
        for (int l = 0; l < at->d; l++)
            roll->p[k * at->d + l] -= x0[core->p.position[l]];
    core->scratch.used = used;
    return failed;
}

/* The optimal change of inputs after a drift (N, nx) from a plan that is its own reference:
 * k_i = M^-1 B'(P drift + ...) backwards, du = -k - K de forwards; de replaces the drift. */
static void regulate(scp_core *core, const double *A, const double *B, const double *K,
                     const double *T, const double *costs, double *drift, double *du)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    double *force = doubles(&core->scratch, (size_t)nx), *r = doubles(&core->scratch, (size_t)nu);
    double *before = doubles(&core->scratch, (size_t)nx);
    memset(force, 0, (size_t)nx * sizeof(double));
    memset(du, 0, (size_t)(N * nu) * sizeof(double));
    for (int i = N - 1; i >= 0; i--) { /* `force`: gradient of the cost to go after the drift */
        add(nx, nx, costs + i * nx * nx, drift + i * nx, force);
        memset(r, 0, (size_t)nu * sizeof(double));
        for (int k = 0; k < nu; k++)
            for (int c = 0; c < nx; c++)
                r[k] -= B[(i * nx + c) * nu + k] * force[c];
        for (int k = 0; k < nu; k++) { /* du = T'T r */
            const double *row = T + (i * nu + k) * nu;
            axpy(k + 1, dot(k + 1, row, r), row, du + i * nu);
        }
        memset(before, 0, (size_t)nx * sizeof(double));
        add_t(nx, nx, A + i * nx * nx, force, before);
        add_t(nu, nx, K + i * nu * nx, r, before);
        copy(nx, before, force);
    }
    for (int i = 0; i < N; i++) {
        double *de = drift + i * nx;
        for (int k = 0; i && k < nu; k++)
            du[i * nu + k] -= dot(nx, K + (i * nu + k) * nx, de - nx);
        if (i)
            add(nx, nx, A + i * nx * nx, de - nx, de);
        add(nx, nu, B + i * nx * nu, du + i * nu, de);
    }
    core->scratch.used = used;
}

int tracking(scp_core *core, const double *X, const double *U, double *inputs, double *e)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used, states = (size_t)(N * nx);
    double *A = doubles(&core->scratch, states * (size_t)nx);
    double *B = doubles(&core->scratch, states * (size_t)nu);
    double *K = doubles(&core->scratch, states * (size_t)nu);
    double *T = doubles(&core->scratch, (size_t)(N * nu * nu));
    double *costs = doubles(&core->scratch, states * (size_t)nx);
    double *drift = doubles(&core->scratch, states), *moves = doubles(&core->scratch, (size_t)nx);
    double *du = doubles(&core->scratch, (size_t)(N * nu));
    int failed = model_linearise(core, N, X, U, 1.0, drift, A, B) ||
                 riccati(core, A, B, K, T, costs);
    if (!failed) {
        for (int k = 0; k < N * nx; k++)
            drift[k] -= X[nx + k];
        for (int k = 0; k < nx; k++)
            moves[k] = core->now->x0[k] - X[k];
        add(nx, nx, A, moves, drift);
        regulate(core, A, B, K, T, costs, drift, du);
        for (int k = 0; k < N * nu; k++)
            inputs[k] = U[k] + du[k];
        for (int k = 0; k < N * nx; k++)
            e[k] = X[nx + k] + drift[k] - core->now->x_ref[nx + k];
    }
    core->scratch.used = used;
    return failed;
}

/* Where a plan is, backwards: T times the gradient in its inputs, of what a later optimum leaves.
 * Returns the cost of deviations and inputs. */
static double place(scp_core *core, const rollout *roll, const sensitivity *by, double *here)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    double *force = doubles(&core->scratch, (size_t)nx), *next = doubles(&core->scratch, (size_t)nx);
    double *push = doubles(&core->scratch, (size_t)nu), *effort = doubles(&core->scratch, (size_t)nu);
    double cost = 0;
    memset(next, 0, (size_t)nx * sizeof(double));
    for (int i = core->at.N - 1; i >= 0; i--) {
        const double *e = roll->e + i * nx, *B = roll->along.B + i * nx * nu;
        memset(force, 0, (size_t)nx * sizeof(double));
        add_t(nx, nx, i == core->at.N - 1 ? p->Qf : p->Q, e, force);
        for (int k = 0; k < nx; k++) {
            cost += force[k] * e[k];
            force[k] = 2 * force[k] + next[k];
        }
        for (int k = 0; k < nu; k++)
            push[k] = roll->u[i * nu + k] - p->rest[k], effort[k] = 0;
        add_t(nu, nu, p->R, push, effort);
        for (int k = 0; k < nu; k++) {
            cost += effort[k] * push[k];
            effort[k] *= 2; /* now the gradient in u */
            for (int c = 0; c < nx; c++)
                effort[k] += B[c * nu + k] * force[c];
        }
        for (int k = 0; k < nu; k++) {
            double sum = 0;
            for (int c = 0; c <= k; c++)
                sum += by->T[(i * nu + k) * nu + c] * effort[c];
            here[i * nu + k] = sum;
        }
        memset(next, 0, (size_t)nx * sizeof(double));
        add_t(nx, nx, roll->along.A + i * nx * nx, force, next);
        for (int k = 0; k < nu; k++)
            axpy(nx, -effort[k], by->K + (i * nu + k) * nx, next);
    }
    core->scratch.used = used;
    return cost;
}

int condense(scp_core *core, const rollout *roll, const double *s, sensitivity *room, condensed *c)
{
    const layout *at = &core->at;
    if (!core->linear && sensitivity_along(core, &roll->along, room))
        return 1;
    size_t used = core->scratch.used;
    double *de = doubles(&core->scratch, (size_t)(at->N * at->nx));
    double *du = doubles(&core->scratch, (size_t)at->n);
    double *dp = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    double *free_s = doubles(&core->scratch, (size_t)at->M);
    c->about = roll;
    c->by = core->linear ? &core->always_by : room;
    double cost = place(core, roll, c->by, c->here);
    for (int j = 0; j < at->M; j++) {
        double away = s[j] - core->p.s_ref;
        cost += core->p.s_weight * away * away;
        free_s[j] = at->moving ? core->p.s_ref : s[j];
        if (at->moving)
            c->here[at->n + j] = sqrt(2 * core->p.s_weight) * away;
    }
    c->least = cost - dot(at->nv, c->here, c->here) / 2;
    respond(core, &roll->along, c->by, c->here, -1, de, du);
    moved(core, &roll->along, de, du, dp);
    axpy(at->N * at->nx, 1, roll->e, de);
    axpy(at->n, 1, roll->u, du);
    axpy(at->nodes.size * at->d, 1, roll->p, dp);
    outputs_of(core, dp, free_s, du, de, c->y_free);
    core->scratch.used = used;
    return 0;
}

void y_of(const scp_core *core, const condensed *c, const double *v, double *y)
{
    const layout *at = &core->at;
    arena *room = &((scp_core *)core)->scratch;
    size_t used = room->used;
    double *de = doubles(room, (size_t)(at->N * at->nx)), *du = doubles(room, (size_t)at->n);
    double *dp = doubles(room, (size_t)(at->nodes.size * at->d)), *ds = doubles(room, (size_t)at->M);
    respond(core, &c->about->along, c->by, v, 1, de, du);
    moved(core, &c->about->along, de, du, dp);
    for (int j = 0; j < at->M; j++)
        ds[j] = at->moving ? v[at->n + j] / sqrt(2 * core->p.s_weight) : 0;
    write_outputs(core, dp, ds, du, NULL, de, y);
    axpy(at->ny, 1, c->y_free, y);
    room->used = used;
}

void deviations_of(const scp_core *core, const condensed *c, const double *v, double *e)
{
    const layout *at = &core->at;
    arena *room = &((scp_core *)core)->scratch;
    size_t used = room->used;
    double *du = doubles(room, (size_t)at->n), *step_v = doubles(room, (size_t)at->n);
    for (int k = 0; k < at->n; k++)
        step_v[k] = v[k] - c->here[k];
    respond(core, &c->about->along, c->by, step_v, 1, e, du);
    axpy(at->N * at->nx, 1, c->about->e, e);
    room->used = used;
}

/* All that may be taken at once: `tracking` above `regulate` or a Riccati pass, or less. */
size_t scratch_of_condensing(const scp_core *core)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, states = at->N * nx, takes = 20;
    int most = states * (2 * nx + 2 * nu + 2) + at->n * (nu + 2) + 2 * nx;
    int plan = (at->N + 1) * nx + states + at->nodes.size * at->d + 2 * at->n + at->M;
    int bent = (3 * nx + nu) * at->n;
    most = most > plan ? most : plan;
    most = (most > bent ? most : bent) + 2 * nx * nx + 4 * nx * nu + nu * nu + 3 * nx + 2 * nu;
    return ((size_t)most + 8 * (size_t)takes) * sizeof(double);
}
