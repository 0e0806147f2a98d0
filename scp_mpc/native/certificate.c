/* The certificate: KKT conditions of the original problem, of first and of second order;
 * scp/certificate.py, and the half-spaces of scp/pairs.py.
 *
 * Inputs are rolled out through the dynamics, derivatives are taken along the rolled-out plan, and
 * multipliers nu of the dynamics follow backwards from stationarity in the states,
 *
 *     D' nu = phi_e - 2 Q e,     then in the inputs     2 R u - B' nu - phi_u = 0
 *
 * has to hold, and for sizes that move 2 w (s - s_ref) - phi_s = 0. A point where all this holds
 * may still be a saddle. So the Lagrangian's second derivative must not bend down in any direction
 * in which the strongly active constraints allow to move, to first order, and the weakly active
 * ones too.
 *
 *     lambda      (count,) forces on the pairs of obstacle and node, non-negative
 *     beta        (nf,)   forces of the bounds, positive at lower ones: the reaction
 *     phi         (ny,)   forces of all constraints: sum_k lambda_k grad g_k on positions and sizes
 *                         (positions between samples pass theirs on to states and inputs), and beta
 *     W, F        the Lagrangian's second derivative is I + W - F'F in condensed coordinates
 */
#include "core.h"

static const double STRONG = 1e-6;     /* force, of the largest: strongly active */
static const double TOUCH = 1e-7;      /* distance to a constraint that is none */
static const double DEPENDENT = 1e-12; /* square of what is left of a row, of the largest: none */
static const double LEAST = 1e-300;
static const double ROUNDING = 1e-10;  /* of a state beyond its bounds, which costs nothing */
static const double FLAT = 1e-6;       /* of the largest curvature: what is less is flat */

void lay_out_certificate(scp_core *core, arena *from)
{
    (void)core, (void)from; /* it keeps nothing */
}

/* Python's max(): what is no number does not count, unless it comes first. */
static double larger(double a, double b)
{
    return b > a ? b : a;
}

/* ---- half-spaces */

/* The robot's position at a node, counted from 0 = now. */
static void position(const scp_core *core, const double *x0, const double *y, int node, double *p)
{
    int d = core->at.d;
    for (int l = 0; l < d; l++)
        p[l] = x0[core->p.position[l]] + (node ? y[core->at.p + (node - 1) * d + l] : 0);
}

void find_planes(scp_core *core, const step *at, const pairs *of, const double *y, planes *to)
{
    int d = core->at.d, C = core->at.nodes.size;
    if (to->y != y)
        memcpy(to->y, y, (size_t)core->at.ny * sizeof(double));
    for (int k = 0; k < of->count; k++) {
        int j = of->obstacle[k], node = of->node[k];
        double here[3], before[3];
        no_go set;
        no_go_of(core, at, j, node, &set);
        position(core, at->x0, y, node + 1, here);
        position(core, at->x0, y, node, before);
        for (int l = 0; l < d; l++)
            before[l] -= at->means[(j * (C + 1) + node) * d + l];
        to->g[k] = linearise_no_go(core, &set, here, y[core->at.s + j], before,
                                   to->a + k * (d + 1), to->bend + k * d * (d - 1));
    }
}

/* ---- forces */

void track_of(const scp_core *core, const double *e, double *track)
{
    int nx = core->at.nx;
    for (int i = 0; i < core->at.N; i++, e += nx, track += nx) {
        const double *Q = i == core->at.N - 1 ? core->p.Qf : core->p.Q;
        for (int c = 0; c < nx; c++)
            track[c] = 0;
        for (int r = 0; r < nx; r++, Q += nx)
            for (int c = 0; c < nx; c++)
                track[c] += e[r] * Q[c];
    }
}

void phi_of(const scp_core *core, const pairs *of, const planes *at, const double *force,
            double *phi)
{
    int d = core->at.d;
    memset(phi, 0, (size_t)core->at.ny * sizeof(double));
    for (int k = 0; k < of->count; k++) {
        const double *a = at->a + k * (d + 1);
        for (int l = 0; l < d; l++)
            phi[core->at.p + of->node[k] * d + l] += force[k] * a[l];
        phi[core->at.s + of->obstacle[k]] += force[k] * a[d];
    }
}

static int any(int n, const double *values)
{
    for (int i = 0; i < n; i++)
        if (values[i] != 0)
            return 1;
    return 0;
}

/* y += M'f for M (m, n); forces are few. */
static void push(int m, int n, const double *M, const double *f, double *y)
{
    for (int i = 0; i < m; i++, M += n)
        for (int c = 0; f[i] != 0 && c < n; c++)
            y[c] += f[i] * M[c];
}

/* What forces (C d,) on the positions do to e (N, nx) and u (N, nu). */
static void pull_positions(const scp_core *core, const derivatives *D, const double *phi,
                           double *on_e, double *on_u)
{
    int nx = core->at.nx, nu = core->at.nu, part = core->at.nodes.n * core->at.d;
    int m = core->at.nodes.count * core->at.d - part;
    for (int i = 0; i < core->at.N; i++, phi += m + part) {
        if (i)
            push(m, nx, D->C + i * m * nx, phi, on_e + (i - 1) * nx);
        push(m, nu, D->D + i * m * nu, phi, on_u + i * nu);
        push(part, nx, D->at + i * part * nx, phi + m, on_e + i * nx);
    }
}

/* What forces (nf,) of the bounds do. */
static void pull_bounds(const scp_core *core, const double *reaction, double *on_e, double *on_u)
{
    const layout *at = &core->at;
    const double *rates = reaction + at->rates;
    for (int i = 0; i < at->n; i++)
        on_u[i] += reaction[at->inputs + i];
    for (int i = 0; i < at->rated; i++)
        on_u[i] += rates[i] - (i + at->nu < at->rated ? rates[i + at->nu] : 0);
    for (int i = 0; i < at->N; i++)
        push(at->nb, at->nx, core->p.row, reaction + at->states + i * at->nb, on_e + i * at->nx);
}

void costates_of(scp_core *core, const rollout *roll, const double *track, const double *reaction,
                 const double *phi, double *nu, double *on_u, double *on_s)
{
    const layout *at = &core->at;
    for (int i = 0; i < at->N * at->nx; i++)
        nu[i] = -2 * track[i];
    memset(on_u, 0, (size_t)at->n * sizeof(double));
    for (int j = 0; j < at->M; j++)
        on_s[j] = (phi ? phi[at->s + j] : 0) + (at->moving ? reaction[j] : 0);
    if (phi)
        pull_positions(core, &roll->along, phi + at->p, nu, on_u);
    if (any(at->nf, reaction))
        pull_bounds(core, reaction, nu, on_u);
    derivatives_costates(core, &roll->along, nu);
}

/* ---- first order */

/* Cost and costates of a plan, and how far it is from being stationary. */
static double stationarity(scp_core *core, nominal *n)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    size_t used = core->scratch.used, M = (size_t)at->M;
    int nx = at->nx, nu = at->nu;
    double *track = doubles(&core->scratch, (size_t)(at->N * nx));
    double *thrust = doubles(&core->scratch, (size_t)at->n);
    double *on_u = doubles(&core->scratch, (size_t)at->n), *on_s = doubles(&core->scratch, M);
    double *phi = doubles(&core->scratch, (size_t)at->ny);
    int pushed = any(n->pairs.count, n->force);
    track_of(core, n->roll.e, track);
    n->cost = dot(at->N * nx, track, n->roll.e);
    if (pushed)
        phi_of(core, &n->pairs, &n->planes, n->force, phi);
    costates_of(core, &n->roll, track, n->reaction, pushed ? phi : NULL, n->costates, on_u, on_s);
    for (int i = 0; i < at->N; i++) /* thrust: half the effort's gradient, then all of it */
        for (int c = 0; c < nu; c++) {
            double sum = 0;
            for (int r = 0; r < nu; r++)
                sum += (n->roll.u[i * nu + r] - p->rest[r]) * p->R[r * nu + c];
            thrust[i * nu + c] = sum;
            n->cost += sum * (n->roll.u[i * nu + c] - p->rest[c]);
        }
    double scaling = larger(1, 2 * largest_abs(at->N * nx, track));
    scaling = larger(scaling, 2 * largest_abs(at->n, thrust));
    for (int i = 0; i < at->N; i++) {
        const double *B = n->roll.along.B + i * nx * nu, *costate = n->costates + i * nx;
        for (int c = 0; c < nu; c++)
            thrust[i * nu + c] = 2 * thrust[i * nu + c] - on_u[i * nu + c];
        for (int r = 0; r < nx; r++)
            for (int c = 0; c < nu; c++)
                thrust[i * nu + c] -= costate[r] * B[r * nu + c];
    }
    double most = largest_abs(at->n, thrust);
    for (int j = 0; j < at->M; j++) {
        double away = n->y[at->s + j] - p->s_ref;
        n->cost += p->s_weight * away * away;
        if (at->moving)
            most = larger(most, fabs(2 * p->s_weight * away - on_s[j]));
    }
    core->scratch.used = used;
    return most / scaling;
}

/* Feasibility and complementarity of bounds, and the excess of states. Only changes and states can
 * be beyond their bounds; they may be as far as the program allowed, or where they pay for it. */
static void judge_bounds(scp_core *core, nominal *n, relaxation level, double *feasibility,
                         double *product)
{
    const layout *at = &core->at;
    const double *wide_lower, *wide_upper;
    int limits = at->ny > at->du;
    if (!limits && !any(at->nf, n->reaction))
        return;
    relaxed_bounds(core, level, &wide_lower, &wide_upper);
    for (int i = 0; i < at->nf; i++) {
        int k = at->boxed + i, z = i - at->states;
        double force = n->reaction[i], allowed = 0;
        double below = n->y[k] - core->lower[k], above = core->upper[k] - n->y[k];
        if (limits) {
            double beyond = larger(0, -(above < below ? above : below));
            double low = core->lower[k] - wide_lower[k], high = wide_upper[k] - core->upper[k];
            double wide = below < 0 ? low : high;
            allowed = wide < beyond ? wide : beyond;
            if (z >= 0) {
                n->excess[z] = beyond > ROUNDING ? beyond : 0;
                if (core->p.row_soft[z % at->nb])
                    allowed = fabs(force) >= core->p.state_slack_weight ? beyond : 0;
            }
            *feasibility = larger(*feasibility, beyond - allowed);
        }
        if (force != 0)
            *product = larger(*product, fabs(force * ((force > 0 ? below : above) + allowed)));
    }
}

void certify(scp_core *core, nominal *n, relaxation level)
{
    double feasibility = 0, product = 0, least = 0;
    n->kkt.stationarity = stationarity(core, n);
    for (int k = 0; k < n->pairs.count; k++) {
        double gap = n->planes.g[k] + n->slack[k];
        feasibility = larger(feasibility, -gap);
        product = larger(product, fabs(n->force[k] * gap));
        least = larger(least, -n->force[k]);
    }
    product = larger(product, least);
    judge_bounds(core, n, level, &feasibility, &product);
    n->kkt.feasibility = feasibility;
    n->kkt.complementarity = product / larger(1, n->cost);
    n->kkt.curvature = (double)NAN;
}

/* ---- second order */

/* Orthonormal rows that span those of B (k, nv), in place: the largest that is left comes next, and
 * is made orthogonal twice. Returns how many. */
static int orthonormal(int nv, int k, double *B, double *squares, arena *scratch)
{
    size_t used = scratch->used, width = (size_t)nv * sizeof(double);
    double *swap = doubles(scratch, (size_t)nv), none = 0;
    int rank = 0;
    for (int i = 0; i < k; i++) {
        squares[i] = dot(nv, B + i * nv, B + i * nv);
        none = larger(none, DEPENDENT * squares[i]);
    }
    for (; rank < k && rank < nv; rank++) {
        int best = rank;
        for (int i = rank + 1; i < k; i++)
            best = squares[i] > squares[best] ? i : best;
        double *row = B + rank * nv, *other = B + best * nv;
        if (!(squares[best] > none))
            break;
        memcpy(swap, other, width);
        memmove(other, row, width);
        memcpy(row, swap, width);
        squares[best] = squares[rank];
        for (int i = 0; i < rank; i++)
            axpy(nv, -dot(nv, row, B + i * nv), B + i * nv, row);
        scale(nv, 1 / norm2(nv, row), row);
        for (int i = rank + 1; i < k; i++) {
            axpy(nv, -dot(nv, row, B + i * nv), row, B + i * nv);
            squares[i] = dot(nv, B + i * nv, B + i * nv);
        }
    }
    scratch->used = used;
    return rank;
}

/* Of I - F'F across a basis (rank, nv): that of a matrix as small as F. */
static double smallest_few(scp_core *core, int nv, int q, const double *factors, int rank,
                           const double *basis, double *direction)
{
    arena *room = &core->scratch;
    double *inner = doubles(room, (size_t)(q * nv)), *gram = doubles(room, (size_t)(q * q));
    double *vector = doubles(room, (size_t)q), least, most;
    memcpy(inner, factors, (size_t)(q * nv) * sizeof(double));
    for (int i = 0; i < q; i++)
        for (int b = 0; b < rank; b++)
            axpy(nv, -dot(nv, inner + i * nv, basis + b * nv), basis + b * nv, inner + i * nv);
    gemm_nt(q, nv, q, inner, inner, gram);
    scale(q * q, -1, gram);
    if (eigen_least(q, gram, &least, &most, vector, room))
        return (double)NAN;
    gemv_t(q, nv, inner, vector, direction);
    return (1 + least) / larger(1, -least - 1);
}

/* The upper part of a symmetric matrix, from its lower one. */
static void mirror(int n, double *M)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            M[j * n + i] = M[i * n + j];
}

/* Of M (nv, nv), which is lost, across a basis; its largest counts as no less than `over`, and
 * directions that are gone bend up by that much. */
static double smallest_of(scp_core *core, int nv, double *M, int rank, const double *basis,
                          double over, double *direction)
{
    arena *room = &core->scratch;
    double least, most;
    if (rank) { /* M - B'B M - M B'B + B'B M B'B = M - B'Z - Z'B */
        double *Z = doubles(room, (size_t)(rank * nv)), *inner = doubles(room, (size_t)rank);
        gemm(rank, nv, nv, basis, M, Z);
        for (int r = 0; r < rank; r++) {
            gemv(rank, nv, basis, Z + r * nv, inner);
            for (int b = 0; b < rank; b++)
                axpy(nv, -inner[b] / 2, basis + b * nv, Z + r * nv);
        }
        for (int i = 0; i < nv; i++)
            for (int r = 0; r < rank; r++) {
                axpy(i + 1, -basis[r * nv + i], Z + r * nv, M + i * nv);
                axpy(i + 1, -Z[r * nv + i], basis + r * nv, M + i * nv);
            }
        mirror(nv, M);
        double up = larger(over, largest_abs(nv * nv, M));
        for (int i = 0; i < nv; i++)
            for (int r = 0; r < rank; r++)
                axpy(i + 1, up * basis[r * nv + i], basis + r * nv, M + i * nv);
        mirror(nv, M);
    }
    if (eigen_least(nv, M, &least, &most, direction, room))
        return (double)NAN;
    return least / larger(over, most);
}

/* Smallest eigenvalue on the null space of the rows (k, nv) that are `kept`, over the largest, and
 * its direction. */
static double smallest(scp_core *core, int nv, const double *W, int q, const double *factors, int k,
                       const double *rows, const uint8_t *kept, double *direction)
{
    arena *room = &core->scratch;
    size_t used = room->used, square = (size_t)nv * (size_t)nv;
    double *basis = doubles(room, (size_t)k * (size_t)nv), *squares = doubles(room, (size_t)k);
    double least = 1;
    int count = 0;
    for (int i = 0; i < k; i++)
        if (kept[i])
            memcpy(basis + count++ * nv, rows + i * nv, (size_t)nv * sizeof(double));
    int rank = orthonormal(nv, count, basis, squares, room);
    memset(direction, 0, (size_t)nv * sizeof(double));
    if (rank < nv && !W && q && q <= nv) {
        least = smallest_few(core, nv, q, factors, rank, basis, direction);
    } else if (rank < nv && (W || q)) {
        double *M = doubles(room, square);
        if (W)
            memcpy(M, W, square * sizeof(double));
        else
            memset(M, 0, square * sizeof(double));
        for (int i = 0; i < q; i++)
            for (int r = 0; r < nv; r++)
                axpy(nv, -factors[i * nv + r], factors + i * nv, M + r * nv);
        for (int r = 0; r < nv; r++)
            M[r * nv + r] += 1;
        least = smallest_of(core, nv, M, rank, basis, W ? LEAST : 1, direction);
    }
    room->used = used;
    return least;
}

/* Necessary at a minimum is that no direction of the critical cone bends down. The strongly active
 * rows take directions away altogether. Of the weakly active ones only half of the directions may
 * be gone: where they are free and some direction bends down, it counts if it or its opposite moves
 * away from all of them; else they are held. Rows (k, nv) point towards where they allow to go;
 * their forces (k,) are not negative. */
double least_curvature(scp_core *core, int nv, const double *W, int q, const double *factors, int k,
                       const double *rows, const double *force, double *direction)
{
    size_t used = core->scratch.used;
    uint8_t *kept = bytes(&core->scratch, (size_t)k);
    double most = 1;
    int weak = 0, away = 1, back = 1;
    for (int i = 0; i < k; i++)
        most = larger(most, force[i]);
    for (int i = 0; i < k; i++) {
        kept[i] = !(force[i] <= STRONG * most);
        weak += !kept[i];
    }
    double least = smallest(core, nv, W, q, factors, k, rows, kept, direction);
    if (weak && !(least >= -FLAT)) {
        for (int i = 0; i < k; i++)
            if (!kept[i]) {
                double along = dot(nv, rows + i * nv, direction);
                away &= along >= -TOUCH;
                back &= along <= TOUCH;
            }
        if (!away && back)
            scale(nv, -1, direction);
        if (!away && !back) {
            memset(kept, 1, (size_t)k);
            least = smallest(core, nv, W, q, factors, k, rows, kept, direction);
        }
    }
    core->scratch.used = used;
    return least;
}

/* All that may be taken at once: rows (2 nv, nv) at most, M, and Z, or F and its squares; or what
 * `stationarity` takes. */
size_t scratch_of_certificate(const scp_core *core)
{
    const layout *at = &core->at;
    size_t nv = (size_t)at->nv, takes = 10;
    size_t first = (size_t)(at->N * at->nx + 2 * at->n + at->M + at->ny);
    size_t second = 4 * nv * nv + 6 * nv;
    return ((first > second ? first : second) + 8 * takes) * sizeof(double);
}
