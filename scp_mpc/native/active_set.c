/* The exact solution of a convex program from a guess of its active set; qp/active_set.py.
 *
 *     minimise |w|^2 / 2   subject to   lower <= F v <= upper,  A v >= b,  v = w or origin + back w
 *
 * First, those of the guess that pull leave, the worst at a time. Then forces are admissible, and
 * who is violated the most joins; those whose force it takes away leave on the way (Goldfarb and
 * Idnani, 1983). A force that reaches its l1_weight stays there, and its constraint yields.
 *
 * Rows of active constraints and the Cholesky factor of their products are updated: a row is
 * appended, another one taken away by Givens rotations. All other constraints are only evaluated,
 * through the outputs y = S v. At the end the active set is solved once more from nothing.
 *
 * Notation:
 *     force   positive at lower bounds and half-spaces; w is the sum of forces times rows
 *     active  -1 at a lower bound or half-space, 1 at an upper bound: a force times it is negative
 *     row     of a constraint's value, as it answers to w
 *     held    active and not relaxed: s->index names them, s->rows are their rows
 */
#include <float.h>

#include "core.h"

static const double ACCURACY = 1e-9;   /* of a constraint, in its own unit; */
static const double FINE = 0.1;        /* or this share of the tolerance, if that is less */
static const double HELD = 10;         /* times that at the end, after the last system */
static const double LEAST = 1e-30;     /* of what forces ask: so little pull is none */
static const double SHARE = 0.5;       /* of the worst: who is no better goes along */
static const double PULL = 1e-10;      /* of the largest force: a pull that is none */
static const double POOR = 1e-4;       /* of the largest pivot: too little for the squares */
static const double CLEAN = 1e-2;      /* of the largest pivot: so much needs no correction */
static const double DEPENDENT = 1e-10; /* of the largest pivot: none */
static const double NONE = 1e29;       /* a bound beyond this is none */
static const double ROUNDING = 1e-12;  /* of a point that forces are to lead to */
static const double NOISE = 1e-11;     /* of the largest change of a force: none */

/* What all programs are solved in. */
typedef struct {
    double *factor;       /* lower Cholesky factor of rows rows', row after row, and one more */
    double *wanted;       /* (nv,) what held constraints ask of w beyond `yielding` */
    double *yielding;     /* (nv,) sum of the forces that are at their weight */
    double *w;            /* (nv,) */
    double *plain, *row;  /* (nv,) of the constraint that joins: as it answers to v and to w */
    double *z, *r, *spare, *share; /* (nv,) */
    double *base;         /* (nv, nv) orthonormal rows */
    double *along, *point, *rest; /* (nv,) */
    int *span, *kept;     /* (nv,) entries of a held row before its zeros; constraints */
    double *value, *depth; /* (nf + pairs,) */
    int8_t *side;
    uint8_t *met;         /* (nf + pairs,) */
    double *y;            /* (ny,) outputs that pairs name */
    uint8_t *asked;       /* (ny,) */
} storage;

/* One program on its way to the solution. */
typedef struct {
    const scp_core *core;
    const qp *of;
    solution *s;
    storage *in;
    double *w;            /* s->v where there is no other metric */
    int nv, m;
} search;

void lay_out_active_set(scp_core *core, arena *from)
{
    storage measured, *in = take(from, 1, sizeof *in);
    storage *to = in ? in : &measured;
    size_t nv = (size_t)core->at.nv, m = (size_t)(core->at.nf + core->at.most_pairs);
    to->factor = doubles(from, (nv + 1) * (nv + 2) / 2);
    double **vectors[] = {&to->wanted, &to->yielding, &to->w, &to->plain, &to->row,
                          &to->z, &to->r, &to->spare, &to->share, &to->along, &to->point, &to->rest};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++)
        *vectors[i] = doubles(from, nv);
    to->base = doubles(from, nv * nv);
    to->span = ints(from, nv);
    to->kept = ints(from, nv);
    to->value = doubles(from, m);
    to->depth = doubles(from, m);
    to->side = take(from, m, sizeof(int8_t));
    to->met = bytes(from, m);
    to->y = doubles(from, (size_t)core->at.ny);
    to->asked = bytes(from, (size_t)core->at.ny);
    core->active = in;
}

void lay_out_solution(const scp_core *core, arena *from, solution *s)
{
    size_t nv = (size_t)core->at.nv, m = (size_t)(core->at.nf + core->at.most_pairs);
    s->v = doubles(from, nv);
    s->force = doubles(from, m);
    s->active = take(from, m, sizeof(int8_t));
    s->relaxed = bytes(from, m);
    s->index = ints(from, nv);
    s->rows = doubles(from, nv * nv);
    s->factor = doubles(from, nv * nv);
}

/* ---- the program */

void qp_row(const qp *of, int i, double *row)
{
    size_t nv = (size_t)of->nv;
    if (i < of->nf) {
        memcpy(row, of->F + (size_t)i * nv, nv * sizeof(double));
        return;
    }
    int k = i - of->nf, p = of->at[2 * k], s = of->at[2 * k + 1];
    const double *a = of->a + (size_t)k * (size_t)(of->d + 1);
    memset(row, 0, nv * sizeof(double));
    for (int c = 0; c < of->d; c++)
        axpy(of->nv, a[c], of->S + (size_t)(p + c) * nv, row);
    if (s >= 0)
        axpy(of->nv, a[of->d], of->S + (size_t)s * nv, row);
}

/* Row of S times x: zero from its reach to where the sizes begin. */
static double output(const scp_core *core, const qp *of, int row, const double *x)
{
    const double *S = of->S + (size_t)row * (size_t)of->nv;
    double y = dot(core->reach[row], S, x);
    for (int j = of->n; j < of->nv; j++)
        y += S[j] * x[j];
    return y;
}

/* F x and A x (nf + pairs,), by the outputs that pairs name. */
static void values(const scp_core *core, const qp *of, const double *x, double *to)
{
    storage *in = core->active;
    int d = of->d;
    for (int i = 0; i < of->nf; i++)
        to[i] = output(core, of, core->at.boxed + i, x);
    for (int k = 0; k < of->pairs; k++) {
        in->asked[of->at[2 * k]] = 1;
        if (of->at[2 * k + 1] >= 0)
            in->asked[of->at[2 * k + 1]] = 1;
    }
    for (int k = 0; k < of->pairs; k++) {
        int p = of->at[2 * k], s = of->at[2 * k + 1];
        const double *a = of->a + (size_t)k * (size_t)(d + 1);
        for (int c = 0; c < d && in->asked[p]; c++)
            in->y[p + c] = output(core, of, p + c, x);
        in->asked[p] = 0;
        double value = 0;
        for (int c = 0; c < d; c++)
            value += a[c] * in->y[p + c];
        if (s >= 0) {
            if (in->asked[s])
                in->y[s] = output(core, of, s, x);
            in->asked[s] = 0;
            value += a[d] * in->y[s];
        }
        to[of->nf + k] = value;
    }
}

void violations(scp_core *core, const qp *of, const double *v, double *depth, int8_t *side)
{
    values(core, of, v, depth);
    for (int i = 0; i < of->nf; i++) {
        double below = of->lower[i] - depth[i], above = depth[i] - of->upper[i];
        side[i] = above > below ? 1 : -1;
        depth[i] = above > below ? above : below;
    }
    for (int k = 0; k < of->pairs; k++) {
        side[of->nf + k] = -1;
        depth[of->nf + k] = of->b[k] - depth[of->nf + k];
    }
}

static double bound_of(const qp *of, int i, int side)
{
    return i >= of->nf ? of->b[i - of->nf] : side < 0 ? of->lower[i] : of->upper[i];
}

static double weight_of(const qp *of, int i)
{
    return of->l1_weight ? of->l1_weight[i] : (double)INFINITY;
}

double qp_merit(scp_core *core, const qp *of, const double *v)
{
    storage *in = core->active;
    double merit = of->least + dot(of->nv, v, v) / 2;
    if (of->l1_weight == NULL)
        return merit;
    violations(core, of, v, in->depth, in->side);
    for (int i = 0; i < of->nf + of->pairs; i++)
        if (of->l1_weight[i] <= DBL_MAX && in->depth[i] > 0)
            merit += of->l1_weight[i] * in->depth[i];
    return merit;
}

/* Lower bound of the optimum from any multipliers, stretched as they like best: with g the pull of
 * all forces and c what their constraints ask of v, the dual function at t times the forces is
 * t c - t^2 |g|^2 / 2. */
double dual_bound(scp_core *core, const qp *of, const double *force)
{
    storage *in = core->active;
    double gain = 0, stretch = INFINITY;
    memset(in->z, 0, (size_t)of->nv * sizeof(double));
    for (int i = 0; i < of->nf + of->pairs; i++) {
        double bound = bound_of(of, i, force[i] > 0 ? -1 : 1);
        if (force[i] == 0 || fabs(bound) >= NONE || (i >= of->nf && force[i] < 0))
            continue; /* there is nothing to push at */
        gain += force[i] * bound;
        stretch = fmin(stretch, weight_of(of, i) / fabs(force[i]));
        qp_row(of, i, in->plain);
        axpy(of->nv, force[i], in->plain, in->z);
    }
    if (gain <= 0)
        return of->least;
    double pull2 = dot(of->nv, in->z, in->z);
    stretch = fmin(stretch, pull2 > LEAST * gain ? gain / pull2 : (double)INFINITY);
    if (!(stretch <= DBL_MAX))
        return INFINITY;
    return of->least + stretch * gain - stretch * stretch * pull2 / 2;
}

static int holds_to(scp_core *core, const qp *of, const solution *s, double tolerance)
{
    storage *in = core->active;
    violations(core, of, s->v, in->depth, in->side);
    for (int i = 0; i < of->nf + of->pairs; i++)
        if (s->force[i] * s->active[i] > 0 || !(s->relaxed[i] || in->depth[i] <= tolerance))
            return 0;
    return 1;
}

static double accuracy(const scp_core *core)
{
    return fmin(ACCURACY, FINE * core->p.tolerance);
}

int holds(scp_core *core, const qp *of, const solution *s)
{
    return holds_to(core, of, s, accuracy(core));
}

/* ---- rows and their factor */

static double *factor_row(const search *at, int k)
{
    return at->in->factor + (size_t)k * (size_t)(k + 1) / 2;
}

/* What the metric makes of a vector: back x, or where it is `across`, back'x. */
static void stretch(const search *at, int across, const double *x, double *to)
{
    const metric *by = at->of->metric;
    double *share = at->in->share;
    memcpy(to, x, (size_t)at->nv * sizeof(double));
    if (by->L != NULL && across)
        solve_lower(at->nv, by->L, to);
    else if (by->L != NULL)
        solve_lower_t(at->nv, by->L, to);
    for (int k = 0; by->L == NULL && k < by->q; k++)
        share[k] = by->stretch[k] * dot(at->nv, by->V + (size_t)k * (size_t)at->nv, x);
    for (int k = 0; by->L == NULL && k < by->q; k++)
        axpy(at->nv, share[k], by->V + (size_t)k * (size_t)at->nv, to);
}

static double *held_row(const search *at, int k)
{
    return at->s->rows + (size_t)k * (size_t)at->nv;
}

/* Rows of constraint i as it answers to v and to w; how many entries of the latter come before its
 * zeros. */
static int read_row(const search *at, int i, double *plain, double *row)
{
    const qp *of = at->of;
    qp_row(of, i, plain);
    if (of->metric) {
        stretch(at, 1, plain, row);
        return at->nv;
    }
    memcpy(row, plain, (size_t)at->nv * sizeof(double));
    if (of->n < of->nv)
        return at->nv;
    return at->core->reach[i < of->nf ? at->core->at.boxed + i : of->at[2 * (i - of->nf)]];
}

static void find_v(const search *at)
{
    if (at->of->metric == NULL)
        return;
    stretch(at, 0, at->w, at->s->v);
    axpy(at->nv, 1, at->of->metric->origin, at->s->v);
}

/* x <- L^-1 x and L^-T x */
static void forwards(const search *at, double *x)
{
    for (int i = 0; i < at->s->count; i++) {
        const double *row = factor_row(at, i);
        x[i] = (x[i] - dot(i, row, x)) / row[i];
    }
}

static void backwards(const search *at, double *x)
{
    for (int i = at->s->count - 1; i >= 0; i--) {
        const double *row = factor_row(at, i);
        x[i] /= row[i];
        axpy(i, -x[i], row, x);
    }
}

/* x <- rows z; z <- z + share rows' x */
static void across(const search *at, const double *z, double *x)
{
    for (int i = 0; i < at->s->count; i++)
        x[i] = dot(at->in->span[i], held_row(at, i), z);
}

static void back_across(const search *at, double share, const double *x, double *restrict z)
{
    const int *span = at->in->span;
    int i = 0, k = at->s->count;
    for (; i + 4 <= k; i += 4) { /* four at a time, to load z less often */
        const double *restrict a = held_row(at, i), *restrict b = held_row(at, i + 1);
        const double *restrict c = held_row(at, i + 2), *restrict d = held_row(at, i + 3);
        double p = share * x[i], q = share * x[i + 1], r = share * x[i + 2], t = share * x[i + 3];
        int low = span[i] > span[i + 1] ? span[i] : span[i + 1];
        int high = span[i + 2] > span[i + 3] ? span[i + 2] : span[i + 3];
        for (int j = 0; j < (low > high ? low : high); j++)
            z[j] += (p * a[j] + q * b[j]) + (r * c[j] + t * d[j]);
    }
    for (; i < k; i++)
        axpy(span[i], share * x[i], held_row(at, i), z);
}

/* Least pivot, as a share of the largest one. */
static double condition(const search *at)
{
    double least = INFINITY, largest = 0;
    for (int i = 0; i < at->s->count; i++) {
        double pivot = factor_row(at, i)[i];
        least = pivot < least ? pivot : least;
        largest = pivot > largest ? pivot : largest;
    }
    return at->s->count ? least / largest : 1;
}

/* The factor's next row, for a row to be held; the square of its share of the held ones. */
static double reduce(const search *at, const double *row, int span)
{
    int k = at->s->count;
    double *l = factor_row(at, k);
    for (int j = 0; j < k; j++) {
        const double *other = factor_row(at, j);
        int both = span < at->in->span[j] ? span : at->in->span[j];
        l[j] = (dot(both, held_row(at, j), row) - dot(j, l, other)) / other[j];
    }
    return dot(k, l, l);
}

/* Split a row into r times the held rows and the rest z; |z|^2. The factor's next row is made. */
static double project(const search *at, const double *row, int span)
{
    storage *in = at->in;
    int k = at->s->count;
    reduce(at, row, span);
    memcpy(in->r, factor_row(at, k), (size_t)k * sizeof(double));
    backwards(at, in->r);
    memcpy(in->z, row, (size_t)at->nv * sizeof(double));
    back_across(at, -1, in->r, in->z);
    if (condition(at) < CLEAN) {
        across(at, in->z, in->spare);
        forwards(at, in->spare);
        backwards(at, in->spare);
        back_across(at, -1, in->spare, in->z);
        axpy(k, 1, in->spare, in->r);
    }
    return k < at->nv ? dot(at->nv, in->z, in->z) : 0;
}

/* The row that was projected last is held from now on. */
static void append(const search *at, int i, const double *row, int span, double reach)
{
    int k = at->s->count;
    factor_row(at, k)[k] = sqrt(reach);
    memcpy(held_row(at, k), row, (size_t)at->nv * sizeof(double));
    at->s->index[k] = i;
    at->in->span[k] = span;
    at->s->count++;
}

/* The j-th is held no longer: its row leaves the factor, rotations make that triangular again. */
static void leave(const search *at, int j)
{
    storage *in = at->in;
    int k = at->s->count;
    for (int i = j; i < k - 1; i++) {
        double *row = factor_row(at, i + 1);
        double length = sqrt(row[i] * row[i] + row[i + 1] * row[i + 1]);
        double c = row[i] / length, s = row[i + 1] / length;
        row[i] = length;
        row += i + 2;
        for (int t = i + 2; t < k; row += t + 1, t++) {
            double x = row[i], y = row[i + 1];
            row[i] = c * x + s * y;
            row[i + 1] = c * y - s * x;
        }
        memcpy(factor_row(at, i), factor_row(at, i + 1), (size_t)(i + 1) * sizeof(double));
    }
    size_t left = (size_t)(k - 1 - j);
    memmove(held_row(at, j), held_row(at, j + 1), left * (size_t)at->nv * sizeof(double));
    memmove(at->s->index + j, at->s->index + j + 1, left * sizeof(int));
    memmove(in->span + j, in->span + j + 1, left * sizeof(int));
    memmove(in->wanted + j, in->wanted + j + 1, left * sizeof(double));
    at->s->count--;
}

/* ---- one active set */

/* Forces that make held constraints hold with equality, and the point they lead to. */
static void push(const search *at)
{
    storage *in = at->in;
    int k = at->s->count;
    memcpy(in->r, in->wanted, (size_t)k * sizeof(double));
    memset(in->z, 0, (size_t)at->nv * sizeof(double));
    memset(in->along, 0, (size_t)k * sizeof(double));
    for (int round = 0; round < 2 && k; round++) { /* once more for the rounding */
        forwards(at, in->r);
        backwards(at, in->r);
        axpy(k, 1, in->r, in->along);
        back_across(at, 1, in->r, in->z);
        across(at, in->z, in->r);
        for (int i = 0; i < k; i++)
            in->r[i] = in->wanted[i] - in->r[i];
    }
    for (int i = 0; i < k; i++)
        at->s->force[at->s->index[i]] = in->along[i];
    memcpy(at->w, in->yielding, (size_t)at->nv * sizeof(double));
    axpy(at->nv, 1, in->z, at->w);
    find_v(at);
}

/* The forces that are at their weight, and where they alone lead. */
static void yield_all(const search *at)
{
    storage *in = at->in;
    solution *s = at->s;
    memset(s->force, 0, (size_t)at->m * sizeof(double));
    memset(in->yielding, 0, (size_t)at->nv * sizeof(double));
    for (int i = 0; i < at->m; i++)
        if (s->relaxed[i]) {
            s->force[i] = -s->active[i] * at->of->l1_weight[i];
            int span = read_row(at, i, in->plain, in->row);
            axpy(span, s->force[i], in->row, in->yielding);
        }
    memcpy(at->w, in->yielding, (size_t)at->nv * sizeof(double));
    find_v(at);
}

/* Read a row and what its constraint asks for, as seen from v. */
static int read_held(const search *at, int i, double *wanted)
{
    int span = read_row(at, i, at->in->plain, at->in->row);
    *wanted = bound_of(at->of, i, at->s->active[i]) - dot(at->nv, at->in->plain, at->s->v);
    return span;
}

/* A row less its share of the first `count` orthonormal ones, in place. Twice is enough. */
static void orthogonalise(const search *at, int count, double *row, double *share)
{
    const double *base = at->in->base;
    size_t nv = (size_t)at->nv;
    memset(share, 0, (size_t)count * sizeof(double));
    for (int round = 0; round < 2; round++)
        for (int t = 0; t < count; t++) {
            double length = dot(at->nv, base + (size_t)t * nv, row);
            axpy(at->nv, -length, base + (size_t)t * nv, row);
            share[t] += length;
        }
}

/* The next row of the factor and of the base; 0 if it depends on those before. */
static int extend(const search *at, int i, int span, double least)
{
    storage *in = at->in;
    int k = at->s->count;
    memcpy(in->z, in->row, (size_t)at->nv * sizeof(double));
    orthogonalise(at, k, in->z, factor_row(at, k));
    double pivot = norm2(at->nv, in->z);
    if (!(pivot > least))
        return 0;
    append(at, i, in->row, span, pivot * pivot);
    factor_row(at, k)[k] = pivot;
    scale(at->nv, 1 / pivot, in->z);
    memcpy(in->base + (size_t)k * (size_t)at->nv, in->z, (size_t)at->nv * sizeof(double));
    return 1;
}

/* Values of all rows times x, which is in coordinates of w. */
static void values_along(const search *at, const double *x)
{
    storage *in = at->in;
    if (at->of->metric) {
        stretch(at, 0, x, in->spare);
        x = in->spare;
    }
    values(at->core, at->of, x, in->value);
}

/* The largest entry above zero; -1 for none. */
static int largest_of(int m, const double *of)
{
    int best = -1;
    for (int i = 0; i < m; i++)
        if (of[i] > 0 && (best < 0 || of[i] > of[best]))
            best = i;
    return best;
}

/* A largest set of rows that do not depend on each other, the longest remainder first. */
static void pick_rows(const search *at)
{
    storage *in = at->in;
    solution *s = at->s;
    double largest = 0, *left = in->depth; /* squares of the remainders */
    for (int i = 0; i < at->m; i++) {
        left[i] = 0;
        if (s->active[i] && !s->relaxed[i]) {
            int span = read_row(at, i, in->plain, in->row);
            left[i] = dot(span, in->row, in->row);
        }
    }
    s->count = 0;
    while (s->count < at->nv) {
        int next = largest_of(at->m, left);
        if (next < 0)
            return;
        double wanted;
        int span = read_held(at, next, &wanted);
        left[next] = 0;
        if (!extend(at, next, span, DEPENDENT * largest))
            continue;
        int k = s->count - 1;
        in->wanted[k] = wanted;
        largest = k ? largest : factor_row(at, 0)[0];
        values_along(at, in->base + (size_t)k * (size_t)at->nv);
        for (int i = 0; i < at->m; i++) /* never to nothing: how little is left is seen then */
            if (left[i] > 0)
                left[i] = fmax(left[i] - in->value[i] * in->value[i], DBL_MIN);
    }
}

/* Forces that lead to a point with held rows, towards those there are until one would pull; whether
 * all push. Those that would pull are held no longer. */
static int least_squares(const search *at, const double *point)
{
    storage *in = at->in;
    solution *s = at->s;
    across(at, point, in->r);
    forwards(at, in->r);
    backwards(at, in->r);
    double share = 1;
    int first = -1;
    for (int t = 0; t < s->count; t++) {
        int i = s->index[t];
        if (in->r[t] * s->active[i] < 0)
            continue;
        double stop = s->force[i] == in->r[t] ? 0 : s->force[i] / (s->force[i] - in->r[t]);
        if (first < 0 || stop < share)
            share = stop, first = t;
    }
    for (int t = 0; t < s->count; t++) {
        double *force = &s->force[s->index[t]];
        *force = first < 0 ? in->r[t] : *force + share * (in->r[t] - *force);
    }
    for (int t = s->count - 1; t >= 0 && first >= 0; t--)
        if (t == first || s->force[s->index[t]] * s->active[s->index[t]] >= 0) {
            s->force[s->index[t]] = 0;
            leave(at, t);
        }
    return first < 0;
}

/* Non-negative least squares (Lawson and Hanson, 1974): forces that push, and lead to a point with
 * rows that are `met`; whether there are any. */
static int pushing(const search *at, const double *point)
{
    storage *in = at->in;
    solution *s = at->s;
    double size = fmax(1, norm2(at->nv, point)), missed = INFINITY;
    s->count = 0;
    memcpy(in->rest, point, (size_t)at->nv * sizeof(double));
    for (int turn = 0; turn < 3 * at->nv; turn++) {
        values_along(at, in->rest);
        int next = -1;
        for (int i = 0; i < at->m; i++) {
            in->value[i] *= -s->active[i];
            if (in->met[i] && s->force[i] == 0 && in->value[i] > ROUNDING * size
                && (next < 0 || in->value[i] > in->value[next]))
                next = i;
        }
        if (next < 0)
            break;
        int span = read_row(at, next, in->plain, in->row);
        double reach = project(at, in->row, span);
        if (!(reach > DEPENDENT * dot(span, in->row, in->row))) {
            in->met[next] = 0;
            continue;
        }
        append(at, next, in->row, span, reach);
        while (!least_squares(at, point))
            ;
        if (s->force[next] == 0)
            in->met[next] = 0; /* it left at once: rounding */
        memcpy(in->rest, point, (size_t)at->nv * sizeof(double));
        for (int t = 0; t < s->count; t++)
            axpy(in->span[t], -s->force[s->index[t]], held_row(at, t), in->rest);
        missed = norm2(at->nv, in->rest);
        if (missed <= ROUNDING * size)
            break;
    }
    return s->count > 0 && missed <= ACCURACY * size;
}

/* Those in `kept` are held, in their order; the others are not active any more. */
static void hold_only(const search *at, int kept)
{
    storage *in = at->in;
    solution *s = at->s;
    memset(in->met, 0, (size_t)at->m);
    for (int t = 0; t < kept; t++)
        in->met[in->kept[t]] = 1;
    s->count = 0;
    for (int i = 0; i < at->m; i++) {
        double wanted;
        if (s->relaxed[i] || !s->active[i])
            continue;
        if (in->met[i] && extend(at, i, read_held(at, i, &wanted), 0))
            in->wanted[s->count - 1] = wanted;
        else
            s->active[i] = 0;
    }
}

/* Solve with a largest set of rows that do not depend on each other, without squaring them. At a
 * degenerate vertex many sets lead to the same point, but not all of them with forces that push;
 * non-negative least squares find one that does. */
static void independent(const search *at)
{
    storage *in = at->in;
    solution *s = at->s;
    size_t nv = (size_t)at->nv;
    pick_rows(at);
    forwards(at, in->wanted);
    memset(in->point, 0, nv * sizeof(double));
    for (int t = 0; t < s->count; t++)
        axpy(at->nv, in->wanted[t], in->base + (size_t)t * nv, in->point);
    backwards(at, in->wanted);
    int kept = s->count, held = 0, any = 0;
    memcpy(in->kept, s->index, (size_t)kept * sizeof(int));
    memcpy(in->along, in->wanted, (size_t)kept * sizeof(double));
    values(at->core, at->of, s->v, in->depth);
    values_along(at, in->point);
    for (int i = 0; i < at->m; i++) {
        int here = s->active[i] && !s->relaxed[i];
        held += here;
        in->met[i] = here && fabs(bound_of(at->of, i, s->active[i]) - in->depth[i] - in->value[i])
                                 <= ACCURACY;
        any |= in->met[i];
    }
    if (held == kept || !any || !pushing(at, in->point)) {
        for (int i = 0; i < at->m; i++)
            s->force[i] = s->relaxed[i] ? s->force[i] : 0;
        for (int t = 0; t < kept; t++)
            s->force[in->kept[t]] = in->along[t];
    } else {
        kept = s->count;
        memcpy(in->kept, s->index, (size_t)kept * sizeof(int));
    }
    hold_only(at, kept);
    memcpy(at->w, in->yielding, nv * sizeof(double));
    axpy(at->nv, 1, in->point, at->w);
    find_v(at);
}

/* Solve for exactly this active set; of rows that depend on others the surplus is left out. */
static void solve_on(const search *at)
{
    storage *in = at->in;
    solution *s = at->s;
    yield_all(at);
    s->count = 0;
    for (int i = 0; i < at->m; i++) {
        if (!s->active[i] || s->relaxed[i])
            continue;
        double left = 0;
        if (s->count < at->nv) {
            int span = read_held(at, i, &in->wanted[s->count]);
            left = dot(span, in->row, in->row) - reduce(at, in->row, span);
            if (left > 0)
                append(at, i, in->row, span, left);
        }
        if (!(left > 0)) {
            independent(at);
            return;
        }
    }
    if (condition(at) <= POOR)
        independent(at);
    else
        push(at);
}

/* ---- from a guess to the solution */

static double largest_force(const search *at)
{
    return fmax(1, largest_abs(at->m, at->s->force));
}

/* The force of the j-th held constraint stays at its weight. */
static void yield_one(const search *at, int j)
{
    storage *in = at->in;
    int i = at->s->index[j];
    double force = -at->s->active[i] * weight_of(at->of, i);
    const double *row = held_row(at, j);
    axpy(in->span[j], force, row, in->yielding);
    across(at, row, in->r);
    axpy(at->s->count, -force, in->r, in->wanted);
    leave(at, j);
    at->s->relaxed[i] = 1;
    at->s->force[i] = force;
}

/* Take away who pulls, let those yield whose force is too large, until forces are admissible. */
static int admissible(const search *at, int most, int *systems)
{
    solution *s = at->s;
    while (dot(at->nv, at->w, at->w) <= DBL_MAX) {
        double worst = 0, largest = largest_force(at);
        int strained = 0;
        for (int j = 0; j < s->count; j++) {
            int i = s->index[j];
            worst = fmax(worst, s->force[i] * s->active[i]);
            strained |= fabs(s->force[i]) > weight_of(at->of, i) * (1 + PULL);
        }
        int pulls = worst > PULL * largest;
        if (!pulls && !strained)
            return 1;
        if (*systems > most)
            return 0;
        for (int j = s->count - 1; j >= 0; j--) {
            int i = s->index[j];
            if (pulls && s->force[i] * s->active[i] >= SHARE * worst) {
                s->active[i] = 0;
                s->force[i] = 0;
                leave(at, j);
            } else if (!pulls && fabs(s->force[i]) > weight_of(at->of, i) * (1 + PULL)) {
                yield_one(at, j);
            }
        }
        push(at);
        ++*systems;
    }
    return 0;
}

/* Who is violated the most, by how much and at which side, or who yields though there is room; the
 * dual objective; -1 where there are no numbers. */
static int survey(const search *at, double *deepest, int *where, double *dual)
{
    const solution *s = at->s;
    const qp *of = at->of;
    const double *value = at->in->value;
    int worst = 0;
    find_v(at);
    values(at->core, of, s->v, at->in->value);
    *dual = of->least + dot(at->nv, at->w, at->w) / 2;
    *deepest = -INFINITY;
    for (int i = 0; i < at->m; i++) {
        if (s->active[i] && !s->relaxed[i])
            continue;
        double below = bound_of(of, i, -1) - value[i];
        double above = i < of->nf ? value[i] - of->upper[i] : -INFINITY, deep;
        if (s->relaxed[i]) {
            double lacks = s->active[i] < 0 ? below : above;
            *dual += of->l1_weight[i] * lacks;
            deep = -lacks;
        } else {
            deep = above > below ? above : below;
        }
        if (isnan(deep))
            return -1;
        if (deep > *deepest)
            *deepest = deep, worst = i, *where = above > below ? 1 : -1;
    }
    return worst;
}

/* How far the forces may go, by r times the length: to zero, or to their weight. */
typedef struct {
    double length;
    int j, strained;
} way;

/* Until the force of a held constraint falls to zero or reaches its weight, as the one that joins
 * rises; `sign` is that of its row. */
static way room_of(const search *at, double sign)
{
    const solution *s = at->s;
    const double *r = at->in->r;
    way free = {INFINITY, -1, 0};
    double noise = NOISE * largest_abs(s->count, r);
    for (int j = 0; j < s->count; j++) {
        int i = s->index[j];
        double fall = -s->active[i] * sign * r[j], force = fabs(s->force[i]);
        double length = INFINITY;
        if (fall > noise)
            length = force / fall;
        else if (fall < -noise && at->of->l1_weight)
            length = (at->of->l1_weight[i] - force) / -fall;
        if (length < free.length)
            free = (way){length, j, fall < 0};
    }
    return free;
}

/* Let a constraint join that lacks so much, or one that yields hold again; QP_SOLVED if it does. */
static qp_end admit(const search *at, int p, double lacks, int most, int *systems)
{
    storage *in = at->in;
    solution *s = at->s;
    int yields = s->relaxed[p], span = read_row(at, p, in->plain, in->row);
    double sign = s->active[p] * (yields ? 1 : -1), weight = weight_of(at->of, p);
    double square = dot(span, in->row, in->row);
    s->relaxed[p] = 0;
    for (;;) {
        if (*systems >= most)
            return QP_UNSOLVED;
        ++*systems;
        double reach = project(at, in->row, span);
        if (!(square <= DBL_MAX && reach >= 0)) /* no numbers */
            return QP_UNSOLVED;
        double whole = reach > DEPENDENT * square ? lacks / reach : (double)INFINITY;
        double own = yields ? fabs(s->force[p]) : weight - fabs(s->force[p]);
        way free = room_of(at, sign);
        double length = fmin(fmin(whole, own), free.length);
        if (!(length <= DBL_MAX))
            return QP_INFEASIBLE;
        axpy(at->nv, length * sign, in->z, at->w);
        lacks -= length * reach;
        s->force[p] += length * sign;
        for (int j = 0; j < s->count; j++) { /* none beyond zero */
            int i = s->index[j];
            double force = s->force[i] - length * sign * in->r[j];
            s->force[i] = force * s->active[i] > 0 ? 0 : force;
        }
        if (length == whole) {
            append(at, p, in->row, span, reach);
            return QP_SOLVED;
        }
        if (length == own) {
            s->force[p] = yields ? 0 : sign * weight;
            s->active[p] = yields ? 0 : s->active[p];
            s->relaxed[p] = (uint8_t)!yields;
            return QP_SOLVED;
        }
        int i = s->index[free.j];
        s->force[i] = free.strained ? -s->active[i] * at->of->l1_weight[i] : 0;
        s->relaxed[i] = (uint8_t)free.strained;
        s->active[i] = free.strained ? s->active[i] : 0;
        leave(at, free.j);
    }
}

/* Rows as they answer to v, and their factor as the others like it. */
static int unpack(const search *at)
{
    solution *s = at->s;
    size_t k = (size_t)s->count;
    if (at->of->metric) {
        for (int i = 0; i < s->count; i++)
            qp_row(at->of, s->index[i], held_row(at, i));
        gemm_nt(s->count, at->nv, s->count, s->rows, s->rows, s->factor);
        return cholesky(s->count, s->factor) == 0;
    }
    memset(s->factor, 0, k * k * sizeof(double));
    for (int i = 0; i < s->count; i++)
        memcpy(s->factor + (size_t)i * k, factor_row(at, i), (size_t)(i + 1) * sizeof(double));
    return 1;
}

/* The solution, its rounding gone, if it is one. */
static qp_end finish(scp_core *core, const search *at, int systems)
{
    solution *s = at->s;
    if (systems > 1)
        solve_on(at);
    double wrong = 0;
    for (int i = 0; i < at->m; i++)
        if (!s->relaxed[i] && s->force[i] * s->active[i] > 0) {
            wrong = fmax(wrong, fabs(s->force[i])); /* rounding, or the vertex is degenerate */
            s->force[i] = 0;
        }
    if (wrong > PULL * largest_force(at) || (systems > 1 && !holds_to(core, at->of, s, HELD * accuracy(core))))
        return QP_UNSOLVED;
    return unpack(at) ? QP_SOLVED : QP_UNSOLVED;
}

qp_end settle(scp_core *core, const qp *of, solution *s, int most, double limit, int *systems)
{
    storage *in = core->active;
    search at = {core, of, s, in, of->metric ? in->w : s->v, of->nv, of->nf + of->pairs};
    for (int i = 0; i < at.m; i++) {
        int side = s->active[i];
        if (side && (fabs(bound_of(of, i, side)) >= NONE || (i >= of->nf && side > 0)))
            s->active[i] = 0;
        if (!s->active[i] || !(weight_of(of, i) <= DBL_MAX))
            s->relaxed[i] = 0;
    }
    *systems = 1;
    solve_on(&at);
    if (!admissible(&at, most, systems))
        return QP_UNSOLVED;
    for (;;) {
        double deepest, dual;
        int side = -1, p = survey(&at, &deepest, &side, &dual);
        if (p < 0)
            return QP_UNSOLVED;
        if (dual > limit)
            return QP_CUT;
        if (deepest <= accuracy(core))
            return finish(core, &at, *systems);
        if (!s->relaxed[p])
            s->active[p] = (int8_t)side;
        qp_end end = admit(&at, p, deepest, most + 1, systems);
        if (end != QP_SOLVED)
            return end;
    }
}
