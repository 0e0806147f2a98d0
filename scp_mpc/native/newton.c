/* From a convex step to Newton's: the geometric series that the convex steps would add up to.
 * scp_mpc/scp/newton.py, and what transcription.py says of curvature.
 *
 * The convex subproblem leaves out that half-spaces turn as the plan moves along a curved obstacle.
 * A step d of it is followed by T d, then T^2 d and so on; their sum is Newton's step on the
 * original problem's KKT conditions,
 *
 *     (I - T)^-1 d = d + P F'(I - F P F')^-1 F d,    P = I - A'(A A')^-1 A
 *
 * and I - F P F' is positive definite: the second-order condition. Where the dynamics bend, too,
 * the Lagrangian's second derivative is I + W, and Newton's step goes on from the convex one within
 * the null space of A: P (I + W) P z = -P W d. Where it would leave the active set, the program is
 * solved again with that second derivative for its Hessian, negative curvature replaced by a little
 * that is positive.
 *
 * Notation:
 *     d   (nv,)       step of the condensed problem
 *     A   (k, nv)     responses of the active constraints; R orthonormal rows that span theirs
 *     F   (q, nv)     responses of the curvature factors, each times the root of its force
 *     W   (nv, nv)    what the convex program leaves out; -F'F for a linear robot
 */
#include "core.h"

static const double STEPS[] = {0.5, 0.1, 0.02}; /* of the inputs' range, to leave a saddle */
static const double LESS = 1e-9;       /* relative fall of the merit that is none */
static const double FLAT = 0.1;        /* least curvature of a program; that of the cost is one */
static const double NEGLIGIBLE = 1e-6; /* force that is none */
static const double TOUCH = 1e-7;      /* distance to a constraint that counts as none */
static const double TOLERANCE = 1e-6;  /* of the largest curvature: what is less is flat */
enum {
    CHANGES = 30,     /* of the active set, in a program with the Lagrangian's Hessian */
    RESTORATIONS = 3, /* steps, */
    MOST = 100        /* and changes of the active set in each */
};

typedef struct {
    solution turned;       /* of a program with the Lagrangian's Hessian */
    double *v, *force;     /* of a solution that is otherwise the convex one's */
    double *corrected;     /* (nv,) */
    solution whole, after; /* borrow the rest */
} newton_room;

void lay_out_newton(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    newton_room *kept = take(from, 1, sizeof *kept), room;
    memset(&room, 0, sizeof room);
    lay_out_solution(core, from, &room.turned);
    room.v = doubles(from, (size_t)at->nv);
    room.force = doubles(from, (size_t)(at->nf + at->most_pairs));
    room.corrected = doubles(from, (size_t)at->nv);
    core->newton = kept;
    if (kept != NULL)
        *kept = room;
}

size_t scratch_of_newton(const scp_core *core)
{
    const layout *at = &core->at;
    size_t nv = (size_t)at->nv, all = (size_t)(at->nf + at->most_pairs);
    size_t stage = (size_t)(at->nx + at->nu), N = (size_t)at->N;
    size_t plan = (N + 1) * (size_t)(3 * at->nx + 2 * at->nu + 1) + 2 * (size_t)at->ny;
    size_t reals = 6 * nv * nv + 8 * nv + plan + N * stage * stage + 2 * all;
    return reals * sizeof(double) + 2 * all + 40 * 64;
}

/* ---- curvature of the half-spaces that push */

static int pushing(const program *p, const double *force)
{
    int count = 0;
    for (int k = 0; k < p->qp.pairs; k++)
        count += force[k] > NEGLIGIBLE;
    return count;
}

/* How the half-space of pair k bends, times the root of its force: L (d+1, d-1) on outputs, and its
 * d-1 rows in v. */
static void factor_of(const scp_core *core, const program *p, int k, double force, double *L,
                      double *rows)
{
    const layout *at = &core->at;
    const planes *of = &p->planes;
    int d = at->d, nv = at->nv, j = p->about->pairs.obstacle[k], i = p->about->pairs.node[k];
    const double *S = p->c.by->S + (at->p + i * d) * nv;
    no_go set;
    no_go_of(core, core->now, j, i, &set);
    no_go_curvature(core, &set, of->y[at->s + j], of->g[k], of->a + k * (d + 1),
                    of->bend + k * d * (d - 1), L);
    memset(rows, 0, (size_t)((d - 1) * nv) * sizeof *rows);
    scale((d + 1) * (d - 1), sqrt(force), L);
    for (int m = 0; m < d - 1; m++) {
        for (int w = 0; w < d; w++)
            axpy(core->reach[at->p + i * d + w], L[w * (d - 1) + m], S + w * nv, rows + m * nv);
        if (at->moving)
            axpy(nv, L[d * (d - 1) + m], p->c.by->S + (at->s + j) * nv, rows + m * nv);
    }
}

/* F (q, nv) of all that push, and where it is asked for F d (q,) of the step to v from where the
 * half-spaces were taken; returns q. */
static int factors_of(const scp_core *core, const program *p, const double *force, const double *v,
                      double *F, double *turned)
{
    const layout *at = &core->at;
    int d = at->d, nv = at->nv, q = 0;
    for (int k = 0; k < p->qp.pairs; k++) {
        double L[8], moved[4];
        if (!(force[k] > NEGLIGIBLE))
            continue;
        factor_of(core, p, k, force[k], L, F + q * nv);
        for (int w = 0; turned != NULL && w <= d; w++) {
            int row = w < d ? at->p + p->about->pairs.node[k] * d + w
                            : at->s + p->about->pairs.obstacle[k];
            moved[w] = p->c.y_free[row] + dot(nv, p->c.by->S + row * nv, v) - p->planes.y[row];
        }
        for (int m = 0; m < d - 1; m++, q++)
            for (int w = 0; turned != NULL && w <= d; w++)
                turned[q] = (w ? turned[q] : 0.0) + L[w * (d - 1) + m] * moved[w];
    }
    return q;
}

/* W -= F'F, and where it is asked for left -= F'(F d): for more rows than there is room for. */
static void subtract_factors(const scp_core *core, const program *p, const double *force,
                             const double *v, double *W, double *left)
{
    const layout *at = &core->at;
    int d = at->d, nv = at->nv;
    arena *scratch = (arena *)&core->scratch;
    size_t mark = scratch->used;
    double *rows = doubles(scratch, (size_t)(2 * nv));
    for (int k = 0; k < p->qp.pairs; k++) {
        double L[8], turned[2] = {0.0, 0.0};
        if (!(force[k] > NEGLIGIBLE))
            continue;
        factor_of(core, p, k, force[k], L, rows);
        for (int m = 0; m < d - 1; m++) {
            const double *row = rows + m * nv;
            for (int i = 0; i < nv; i++)
                if (row[i] != 0)
                    axpy(nv, -row[i], row, W + i * nv);
            if (left == NULL)
                continue;
            for (int w = 0; w <= d; w++) {
                int y = w < d ? at->p + p->about->pairs.node[k] * d + w
                              : at->s + p->about->pairs.obstacle[k];
                double moved = p->c.y_free[y] + dot(nv, p->c.by->S + y * nv, v) - p->planes.y[y];
                turned[m] += L[w * (d - 1) + m] * moved;
            }
            axpy(nv, -turned[m], row, left);
        }
    }
    scratch->used = mark;
}

/* ---- curvature of the dynamics */

/* The part (nv, nv) of dynamics and positions of a nonlinear robot. */
static void dynamics_curvature(scp_core *core, const program *p, const solution *s, double *W)
{
    const layout *at = &core->at;
    const rollout *about = p->c.about;
    int states = at->N * at->nx, stage = at->nx + at->nu;
    size_t mark = core->scratch.used;
    double *e = doubles(&core->scratch, (size_t)states);
    double *nu = doubles(&core->scratch, (size_t)states);
    double *X = doubles(&core->scratch, (size_t)(states + at->nx));
    double *phi = doubles(&core->scratch, (size_t)at->ny);
    double *on_u = doubles(&core->scratch, (size_t)(at->n + at->M));
    double *stages = doubles(&core->scratch, (size_t)(at->N * stage * stage));
    double *sway = doubles(&core->scratch, (size_t)at->N);
    int pushed = pushing(p, s->force + at->nf) > 0;
    deviations_of(core, &p->c, s->v, e);
    track_of(core, e, nu);
    memcpy(e, nu, (size_t)states * sizeof *e);
    memset(phi, 0, (size_t)at->ny * sizeof *phi);
    phi_of(core, &p->about->pairs, &p->planes, s->force + at->nf, phi);
    costates_of(core, about, e, s->force, pushed ? phi : NULL, nu, on_u, on_u + at->n);
    scale(states, -1.0, nu);
    scale(at->ny, -1.0, phi);
    states_of(core, about, X);
    int sways = nodes_curvature(core, X, about->u, nu, phi + at->p, stages, sway);
    curvature_in_v(core, p->c.by, stages, sways ? sway : NULL, W);
    core->scratch.used = mark;
}

/* W of a nonlinear robot at the convex solution of a program. */
static const double *curvature(scp_core *core, program *p, const solution *convex)
{
    if (!p->bent) {
        dynamics_curvature(core, p, convex, p->W);
        subtract_factors(core, p, convex->force + core->at.nf, NULL, p->W, NULL);
        p->bent = 1;
    }
    return p->W;
}

double bent_by(scp_core *core, program *p, const solution *convex, const double *v)
{
    int nv = core->at.nv;
    const double *W = curvature(core, p, convex);
    size_t mark = core->scratch.used;
    double *d = doubles(&core->scratch, (size_t)(2 * nv));
    for (int i = 0; i < nv; i++)
        d[i] = v[i] - p->c.here[i];
    gemv(nv, nv, W, d, d + nv);
    core->scratch.used = mark;
    return dot(nv, d, d + nv) / 2;
}

/* ---- Newton's step */

static solution *borrowed(newton_room *room, int nv, const solution *from, int all)
{
    room->whole = *from;
    room->whole.v = room->v;
    room->whole.force = room->force;
    memcpy(room->v, from->v, (size_t)nv * sizeof(double));
    memcpy(room->force, from->force, (size_t)all * sizeof(double));
    return &room->whole;
}

/* The solution that the convex steps from this one on tend to; NULL if they do not. turn (q,) is
 * F d, the convex step as the curvature factors see it, and is destroyed. */
static const solution *summed(scp_core *core, const program *p, const solution *s, int q,
                              const double *F, double *turn)
{
    int nv = core->at.nv, k = s->count;
    size_t mark = core->scratch.used;
    double *bent = doubles(&core->scratch, (size_t)(q * q));
    double *within = doubles(&core->scratch, (size_t)(q * k));
    double *change = doubles(&core->scratch, (size_t)k);
    for (int i = 0; i < q; i++) {
        gemv(k, nv, s->rows, F + i * nv, within + i * k);
        solve_lower(k, s->factor, within + i * k);
        for (int j = 0; j <= i; j++)
            bent[i * q + j] = (i == j) - dot(nv, F + i * nv, F + j * nv) +
                              dot(k, within + i * k, within + j * k);
    }
    solution *whole = NULL;
    if (!cholesky(q, bent)) {
        whole = borrowed(core->newton, nv, s, p->qp.nf + p->qp.pairs);
        solve_lower(q, bent, turn);
        solve_lower_t(q, bent, turn);
        gemv_t(q, k, within, turn, change);
        solve_lower_t(k, s->factor, change);
        for (int i = 0; i < q; i++)
            axpy(nv, turn[i], F + i * nv, whole->v);
        for (int i = 0; i < k; i++) {
            axpy(nv, -change[i], s->rows + i * nv, whole->v);
            whole->force[s->index[i]] -= change[i];
        }
    }
    core->scratch.used = mark;
    return whole;
}

/* Orthonormal rows R (k, nv) that span those of the active constraints: factor^-1 rows. */
static void orthonormal(int nv, const solution *s, double *R)
{
    for (int i = 0; i < s->count; i++) {
        double *row = R + i * nv;
        memcpy(row, s->rows + i * nv, (size_t)nv * sizeof *row);
        for (int j = 0; j < i; j++)
            axpy(nv, -s->factor[i * s->count + j], R + j * nv, row);
        scale(nv, 1 / s->factor[i * s->count + i], row);
    }
}

/* The solution to which Newton's step leads; NULL without the second-order condition. left (nv,) is
 * W d. */
static const solution *newton_step(scp_core *core, const program *p, const solution *s,
                                   const double *left, const double *W)
{
    int nv = core->at.nv, k = s->count;
    size_t mark = core->scratch.used;
    double *M = doubles(&core->scratch, (size_t)(nv * nv));
    double *R = doubles(&core->scratch, (size_t)(k * nv));
    double *B = doubles(&core->scratch, (size_t)(k * nv));
    double *z = doubles(&core->scratch, (size_t)nv);
    double *pull = doubles(&core->scratch, (size_t)nv);
    double *T = doubles(&core->scratch, (size_t)(nv * nv));
    double *across = doubles(&core->scratch, (size_t)(k * k));
    double *inner = doubles(&core->scratch, (size_t)k);
    memcpy(M, W, (size_t)(nv * nv) * sizeof *M);
    for (int i = 0; i < nv; i++) {
        M[i * nv + i] += 1.0;
        z[i] = -left[i];
    }
    orthonormal(nv, s, R);
    for (int a = 0; a < k; a++)
        axpy(nv, -dot(nv, R + a * nv, z), R + a * nv, z);
    /* P M P + R'R = M - R'B - B'R with B = R M - (R M R' + I) R / 2 */
    gemm(k, nv, nv, R, M, B);
    gemm_nt(k, nv, k, B, R, across);
    for (int a = 0; a < k; a++)
        across[a * k + a] += 1.0;
    scale(k * k, -0.5, across);
    for (int a = 0; a < k; a++)
        for (int b = 0; b < k; b++)
            axpy(nv, across[a * k + b], R + b * nv, B + a * nv);
    gemm_tn(k, nv, nv, R, B, T);
    for (int i = 0; i < nv; i++)
        for (int j = 0; j <= i; j++)
            M[i * nv + j] -= T[i * nv + j] + T[j * nv + i];
    solution *whole = NULL;
    if (!cholesky(nv, M)) {
        whole = borrowed(core->newton, nv, s, p->qp.nf + p->qp.pairs);
        solve_lower(nv, M, z);
        solve_lower_t(nv, M, z);
        axpy(nv, 1.0, z, whole->v);
        gemv(nv, nv, W, z, pull);
        axpy(nv, 1.0, left, pull);
        gemv(k, nv, R, pull, inner);
        solve_lower_t(k, s->factor, inner);
        for (int i = 0; i < k; i++)
            whole->force[s->index[i]] += inner[i];
    }
    core->scratch.used = mark;
    return whole;
}

/* ---- where the active set changes on the way */

/* Solve a program again with the Lagrangian's own Hessian H = C'C; NULL where that is not reached.
 * The objective is |w|^2 / 2 in w = C (v - here) + C^-T here; origin (nv,) is here - H^-1 here. */
static const solution *newton_program(scp_core *core, const program *p, const metric *by,
                                      const solution *from)
{
    int all = p->qp.nf + p->qp.pairs, systems = 0;
    solution *to = &((newton_room *)core->newton)->turned;
    qp turned = p->qp;
    turned.metric = by;
    memcpy(to->active, from->active, (size_t)all * sizeof *to->active);
    memcpy(to->relaxed, from->relaxed, (size_t)all * sizeof *to->relaxed);
    return settle(core, &turned, to, CHANGES, INFINITY, &systems) == QP_SOLVED ? to : NULL;
}

/* By Newton's step on its active set, or else with one that changes: of few curvature factors. */
static const solution *refine_few(scp_core *core, const program *p, const solution *s, int q)
{
    int nv = core->at.nv;
    arena *scratch = &core->scratch;
    const double *here = p->c.here;
    double *F = doubles(scratch, (size_t)(q * nv));
    double *turned = doubles(scratch, (size_t)q);
    factors_of(core, p, s->force + p->qp.nf, s->v, F, turned);
    const solution *whole = summed(core, p, s, q, F, turned);
    if (whole != NULL && holds(core, &p->qp, whole))
        return whole;
    double *gram = doubles(scratch, (size_t)(q * q));
    double *vectors = doubles(scratch, (size_t)(q * q));
    double *V = doubles(scratch, (size_t)(q * nv));
    double *origin = doubles(scratch, (size_t)nv);
    gemm_nt(q, nv, q, F, F, gram);
    if (eigen(q, gram, turned, vectors, scratch))
        return s;
    gemm_tn(q, q, nv, vectors, F, V);
    memset(origin, 0, (size_t)nv * sizeof *origin);
    for (int k = 0; k < q; k++) { /* 1 - roots are H's eigenvalues, rows of V its eigenvectors */
        double root = norm2(nv, V + k * nv), value = fmax(1.0 - turned[k], FLAT);
        scale(nv, root > 0 ? 1 / root : 0.0, V + k * nv);
        axpy(nv, (1 - 1 / value) * dot(nv, V + k * nv, here), V + k * nv, origin);
        turned[k] = 1 / sqrt(value) - 1;
    }
    metric by = {.origin = origin, .V = V, .stretch = turned, .q = q};
    const solution *end = newton_program(core, p, &by, s);
    return end != NULL ? end : s;
}

/* Cholesky factor of I + W, curvature that is negative or small replaced; 0, or no numbers. */
static int factorise(scp_core *core, const double *W, double *L)
{
    int nv = core->at.nv, failed = 0;
    size_t mark = core->scratch.used, size = (size_t)(nv * nv);
    double *H = doubles(&core->scratch, size);
    double *values = doubles(&core->scratch, (size_t)nv);
    double *vectors = doubles(&core->scratch, size);
    memcpy(L, W, size * sizeof *L);
    for (int i = 0; i < nv; i++)
        L[i * nv + i] += 1.0 - FLAT;
    int flat = cholesky(nv, L);
    memcpy(L, W, size * sizeof *L);
    memcpy(H, W, size * sizeof *H);
    if (flat)
        failed = eigen(nv, H, values, vectors, &core->scratch);
    for (int k = 0; flat && !failed && k < nv && 1.0 + values[k] < FLAT; k++) {
        double more = FLAT - 1.0 - values[k];
        for (int i = 0; i < nv; i++)
            for (int j = 0; j <= i; j++)
                L[i * nv + j] += more * vectors[i * nv + k] * vectors[j * nv + k];
    }
    for (int i = 0; i < nv; i++)
        L[i * nv + i] += 1.0;
    core->scratch.used = mark;
    return failed || cholesky(nv, L);
}

/* The same with all of W, which `left` = W d belongs to. */
static const solution *refine_all(scp_core *core, const program *p, const solution *s,
                                  const double *left, const double *W)
{
    int nv = core->at.nv;
    const solution *whole = newton_step(core, p, s, left, W);
    if (whole != NULL && holds(core, &p->qp, whole))
        return whole;
    double *L = doubles(&core->scratch, (size_t)(nv * nv));
    double *origin = doubles(&core->scratch, (size_t)nv);
    if (factorise(core, W, L))
        return s;
    memcpy(origin, p->c.here, (size_t)nv * sizeof *origin);
    solve_lower(nv, L, origin);
    solve_lower_t(nv, L, origin);
    for (int i = 0; i < nv; i++)
        origin[i] = p->c.here[i] - origin[i];
    metric by = {.origin = origin, .L = L};
    const solution *end = newton_program(core, p, &by, s);
    return end != NULL ? end : s;
}

const solution *refine(scp_core *core, program *p, const solution *convex)
{
    int nv = core->at.nv, q = pushing(p, convex->force + p->qp.nf) * (core->at.d - 1);
    size_t mark = core->scratch.used;
    const solution *refined = convex;
    if (core->linear && q > 0 && q <= nv) {
        refined = refine_few(core, p, convex, q);
    } else if (core->linear && q > 0) {
        double *W = doubles(&core->scratch, (size_t)(nv * nv));
        double *left = doubles(&core->scratch, (size_t)nv);
        memset(W, 0, (size_t)(nv * nv) * sizeof *W);
        memset(left, 0, (size_t)nv * sizeof *left);
        subtract_factors(core, p, convex->force + p->qp.nf, convex->v, W, left);
        refined = refine_all(core, p, convex, left, W);
    } else if (!core->linear) {
        const double *W = curvature(core, p, convex);
        double *d = doubles(&core->scratch, (size_t)nv);
        double *left = doubles(&core->scratch, (size_t)nv);
        for (int i = 0; i < nv; i++)
            d[i] = convex->v[i] - p->c.here[i];
        gemv(nv, nv, W, d, left);
        refined = refine_all(core, p, convex, left, W);
    }
    core->scratch.used = mark;
    return refined;
}

/* ---- second-order correction, restoration */

/* The least change that takes the active pairs back to g = 0. A step bends away from its linearised
 * constraints by its square, which the merit would hold against it wherever it is, also next to the
 * optimum (Maratos, 1978). */
const solution *second_order_correction(scp_core *core, const program *p, const solution *s,
                                        const nominal *trial)
{
    newton_room *room = core->newton;
    int nv = core->at.nv, nf = p->qp.nf, any = 0;
    size_t mark = core->scratch.used;
    double *wanted = doubles(&core->scratch, (size_t)s->count);
    for (int i = 0; i < s->count; i++) {
        wanted[i] = s->index[i] < nf ? 0.0 : -trial->planes.g[s->index[i] - nf];
        any |= s->index[i] >= nf;
    }
    if (any && isfinite(trial->cost)) {
        solve_lower(s->count, s->factor, wanted);
        solve_lower_t(s->count, s->factor, wanted);
        room->after = *s;
        room->after.v = room->corrected;
        memcpy(room->corrected, s->v, (size_t)nv * sizeof(double));
        for (int i = 0; i < s->count; i++)
            axpy(nv, wanted[i], s->rows + i * nv, room->corrected);
        s = &room->after;
    }
    core->scratch.used = mark;
    return s;
}

/* A program in steps from a plan, whose half-spaces stand half a tolerance further out. */
static void centre(scp_core *core, program *p)
{
    const layout *at = &core->at;
    const double *here = p->c.here;
    for (int i = 0; i < at->nf; i++) {
        double value = dot(at->nv, p->qp.F + i * at->nv, here);
        p->lower[i] -= value;
        p->upper[i] -= value;
    }
    for (int k = 0; k < p->qp.pairs; k++) {
        const double *a = p->qp.a + k * (at->d + 1);
        for (int w = 0; w <= at->d; w++) {
            int row = w < at->d ? p->at[2 * k] + w : p->at[2 * k + 1];
            if (row >= 0)
                p->b[k] -= a[w] * dot(at->nv, p->qp.S + row * at->nv, here);
        }
        p->b[k] += core->p.tolerance / 2;
    }
}

/* The nearest plan that keeps every constraint, for one that nearly does; NULL for none. Steps of
 * least length onto the linearised constraints, whose error falls with its square. */
nominal *restored(scp_core *core, const nominal *plan, nominal *one, nominal *other)
{
    program *p = &core->work->program;
    solution *s = &core->work->convex;
    size_t mark = core->scratch.used;
    uint8_t *near = bytes(&core->scratch, (size_t)core->at.most_pairs);
    nominal *to = one, *found = NULL;
    int systems;
    for (int i = 0; i < RESTORATIONS && !found; i++, plan = to, to = to == one ? other : one) {
        if (condense(core, &plan->roll, plan->y + core->at.s, &core->work->by, &p->c))
            break;
        write_program(core, plan, &p->c, &plan->planes, RELAX_NONE, NULL, p);
        centre(core, p);
        guess_nothing(p, s);
        if (settle(core, &p->qp, s, MOST, INFINITY, &systems) != QP_SOLVED)
            break;
        axpy(core->at.nv, 1.0, p->c.here, s->v);
        memset(s->relaxed, 0, (size_t)(p->qp.nf + p->qp.pairs));
        memcpy(s->force, plan->reaction, (size_t)p->qp.nf * sizeof(double));
        memcpy(s->force + p->qp.nf, plan->force, (size_t)p->qp.pairs * sizeof(double));
        certified(core, p, s, to);
        double deep = fmax(to->kkt.feasibility,
                           largest_abs(core->at.N * core->at.nb, to->excess));
        if (isfinite(to->cost) && deep <= core->p.tolerance && !screen(core, to, near))
            found = to;
    }
    core->scratch.used = mark;
    return found;
}

/* ---- second-order condition */

/* Rows (k, nv) of the constraints that are active, towards where they allow to go, with forces
 * (k,): those that hold, then those without a force, weakly active. */
static int active_rows(scp_core *core, const program *p, const solution *s, double *rows,
                       double *force)
{
    int nv = core->at.nv, all = p->qp.nf + p->qp.pairs, k = s->count, most = s->count + nv;
    size_t mark = core->scratch.used;
    double *depth = doubles(&core->scratch, (size_t)all);
    int8_t *side = take(&core->scratch, (size_t)all, sizeof *side);
    violations(core, &p->qp, s->v, depth, side);
    for (int i = 0; i < s->count; i++) {
        memcpy(rows + i * nv, s->rows + i * nv, (size_t)nv * sizeof *rows);
        scale(nv, -s->active[s->index[i]], rows + i * nv);
        force[i] = fabs(s->force[s->index[i]]);
    }
    for (int i = 0; i < all && k < most; i++)
        if (depth[i] >= -TOUCH && !s->active[i]) {
            qp_row(&p->qp, i, rows + k * nv);
            scale(nv, -side[i], rows + k * nv);
            force[k++] = fabs(s->force[i]);
        }
    core->scratch.used = mark;
    return k;
}

/* A plan's least curvature becomes known, and the direction (N, nu) of it in inputs.
 *
 * p: the program that led to it; at a KKT point the two agree to first order. s: its solution,
 * which knows the active set. */
void second_order(scp_core *core, const program *p, const solution *s, nominal *plan,
                  double *direction)
{
    const layout *at = &core->at;
    int nv = at->nv, q = pushing(p, s->force + at->nf) * (at->d - 1);
    int few = core->linear && q <= nv;
    size_t mark = core->scratch.used;
    memset(direction, 0, (size_t)at->n * sizeof *direction);
    plan->kkt.curvature = 1.0;
    if (core->linear && !q) /* nothing but the convex program */
        return;
    double *W = doubles(&core->scratch, (size_t)(nv * nv)); /* or F, if there is no other */
    double *rows = doubles(&core->scratch, (size_t)((s->count + nv) * nv));
    double *force = doubles(&core->scratch, (size_t)(s->count + nv));
    double *towards = doubles(&core->scratch, (size_t)nv);
    memset(W, 0, (size_t)(nv * nv) * sizeof *W);
    if (!core->linear)
        dynamics_curvature(core, p, s, W);
    if (few)
        factors_of(core, p, s->force + at->nf, s->v, W, NULL);
    else
        subtract_factors(core, p, s->force + at->nf, s->v, W, NULL);
    int k = active_rows(core, p, s, rows, force);
    plan->kkt.curvature = least_curvature(core, nv, few ? NULL : W, few ? q : 0, few ? W : NULL, k,
                                          rows, force, towards);
    gemv(at->n, nv, p->c.by->S + at->u * nv, towards, direction);
    core->scratch.used = mark;
}

static double merit(const scp_core *core, const nominal *n)
{
    double depth = 0.0;
    for (int k = 0; k < n->pairs.count; k++)
        depth += fmax(-n->planes.g[k], 0.0);
    return merit_of(core, n->cost, depth, n->excess);
}

/* Leave a saddle along a direction (N, nu) of negative curvature; 0 where that is in vain. The
 * first of some ever shorter steps, to either side, after which the merit is less. */
int negative_curvature_step(scp_core *core, const nominal *saddle, const double *direction,
                            nominal *to)
{
    const layout *at = &core->at;
    double largest = 0.0, before = merit(core, saddle);
    int left = 0;
    for (int i = 0; i < at->n; i++) {
        double span = core->p.u_max[i % at->nu] - core->p.u_min[i % at->nu];
        largest = fmax(largest, fabs(direction[i] / (span > 0 ? span : 1.0)));
    }
    if (!(saddle->kkt.curvature < -TOLERANCE && largest > 0))
        return 0;
    size_t mark = core->scratch.used;
    double *U = doubles(&core->scratch, (size_t)at->n);
    for (int i = 0; i < 6 && !left; i++) {
        double length = (i % 2 ? -1 : 1) * STEPS[i / 2] / largest;
        for (int m = 0; m < at->n; m++)
            U[m] = saddle->roll.u[m] + length * direction[m];
        if (rolled(core, U, saddle->y + at->s, NULL, to))
            continue;
        make_pairs(core, saddle->pairs.near, &to->pairs);
        memcpy(to->reaction, saddle->reaction, (size_t)at->nf * sizeof(double));
        memset(to->force, 0, (size_t)to->pairs.count * sizeof(double));
        judge_plan(core, to, NULL, RELAX_NONE);
        left = merit(core, to) < before - LESS * fabs(before);
    }
    core->scratch.used = mark;
    return left;
}
