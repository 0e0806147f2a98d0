/* Collision nodes: where along a plan the obstacles are constrained, and what happens in between;
 * scp/nodes.py.
 *
 * Each interval has K instants, the last of which is the sample; a longer robot is covered by n
 * discs along its heading, and each is a node of its own. Between two instants, if the centres of
 * robot and obstacle are r' apart at both and move l relative to each other along a straight line,
 * they never come closer than sqrt(r'^2 - (l/2)^2). A held input bends the robot's way by b off its
 * chord. So the radii r are kept everywhere if the nodes of an interval keep
 *
 *     r' = sqrt((r + b)^2 + (l/2)^2)      with l and b of that interval
 *
 * The nodes of a backup may reach beyond the horizon: a model is asked for as many intervals at
 * once as the horizon has.
 */
#include "core.h"

static const double RESERVE = 1.2; /* of what is assumed about a plan over what is known */

/* The larger one; what is no number stays. */
static double larger(double a, double b)
{
    return a > b || isnan(a) ? a : b;
}

/* For scratch, and to say that a computation broke down. */
static scp_core *mutable_core(const scp_core *core)
{
    return (scp_core *)core;
}

nodes nodes_of(int N, int K, int n)
{
    return (nodes){N, K, n, K * n, N * K * n};
}

/* Whether the robot is one disc about its position. */
static int is_plain(const scp_core *core)
{
    return core->linear || (core->p.discs == 1 && core->p.disc[0] == 0);
}

/* Centres (n, d) of the discs in a state. */
static void bodies(const scp_core *core, const double *x, double *p)
{
    const int *place = core->p.position;
    int d = core->at.d;
    if (is_plain(core)) {
        for (int l = 0; l < d; l++)
            p[l] = x[place[l]];
        return;
    }
    double c = cos(x[core->p.heading]), s = sin(x[core->p.heading]);
    for (int k = 0; k < core->p.discs; k++, p += 2) {
        p[0] = x[place[0]] + core->p.disc[k] * c;
        p[1] = x[place[1]] + core->p.disc[k] * s;
    }
}

/* Their derivatives (n d, nx) with respect to the state. */
static void slopes_of(const scp_core *core, const double *x, double *slopes)
{
    int nx = core->at.nx, d = core->at.d, heading = core->p.heading, plain = is_plain(core);
    double c = plain ? 0 : cos(x[heading]), s = plain ? 0 : sin(x[heading]);
    memset(slopes, 0, (size_t)(core->p.discs * d * nx) * sizeof(double));
    for (int k = 0; k < core->p.discs; k++, slopes += d * nx) {
        for (int l = 0; l < d; l++)
            slopes[l * nx + core->p.position[l]] = 1;
        if (!plain) {
            slopes[heading] = -core->p.disc[k] * s;
            slopes[nx + heading] = core->p.disc[k] * c;
        }
    }
}

/* y = C x + D u for C (m, nx) and D (m, nu). */
static void both(int m, int nx, int nu, const double *C, const double *D, const double *x,
                 const double *u, double *y)
{
    for (int i = 0; i < m; i++, C += nx, D += nu) {
        double sum = 0;
        for (int j = 0; j < nx; j++)
            sum += C[j] * x[j];
        for (int j = 0; j < nu; j++)
            sum += D[j] * u[j];
        y[i] = sum;
    }
}

void nodes_now(const scp_core *core, const double *x0, double *p)
{
    bodies(core, x0, p);
}

/* States (count, nx) after a share of each interval. */
static const double *within_intervals(const scp_core *core, int count, const double *X,
                                      const double *U, double share, double *after)
{
    if (share == 0)
        return X;
    if (model_advance(core, count, X, U, share, after)) {
        mutable_core(core)->broken = 1;
        for (int i = 0; i < count * core->at.nx; i++)
            after[i] = (double)NAN;
    }
    return after;
}

/* Centres (count, n, d) after a share of each interval, `apart` from interval to interval. */
static void positions_at(const scp_core *core, nodes of, const double *X, const double *U,
                         double share, int apart, double *p)
{
    arena *room = &mutable_core(core)->scratch;
    size_t used = room->used;
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    double *after = doubles(room, (size_t)(N * nx));
    for (int first = 0; first < of.N; first += N) {
        int count = of.N - first < N ? of.N - first : N;
        const double *x = X + first * nx;
        x = within_intervals(core, count, x, U + first * nu, share, after);
        for (int i = 0; i < count; i++, x += nx, p += apart)
            bodies(core, x, p);
    }
    room->used = used;
}

void nodes_positions(const scp_core *core, nodes of, const double *X, const double *U, double *p)
{
    int nx = core->at.nx, nu = core->at.nu, part = of.n * core->at.d, m = (of.K - 1) * part;
    for (int i = 0; i < of.N; i++)
        bodies(core, X + (i + 1) * nx, p + i * (m + part) + m);
    for (int i = 0; core->linear && i < of.N && m; i++)
        both(m, nx, nu, core->p.between_x, core->p.between_u, X + i * nx, U + i * nu,
             p + i * (m + part));
    for (int k = 1; !core->linear && k < of.K; k++)
        positions_at(core, of, X, U, (double)k / of.K, m + part, p + (k - 1) * part);
}

/* C (m, nx) and D (m, nu) of positions (n, d) after a share of an interval: slopes times A, B */
static void chained(const scp_core *core, const double *slopes, const double *A, const double *B,
                    double *C, double *D)
{
    int nx = core->at.nx, nu = core->at.nu, part = core->p.discs * core->at.d;
    memset(C, 0, (size_t)(part * nx) * sizeof(double));
    memset(D, 0, (size_t)(part * nu) * sizeof(double));
    for (int r = 0; r < part; r++)
        for (int k = 0; k < nx; k++) {
            double slope = slopes[r * nx + k];
            for (int j = 0; slope != 0 && j < nx; j++)
                C[r * nx + j] += slope * A[k * nx + j];
            for (int j = 0; slope != 0 && j < nu; j++)
                D[r * nu + j] += slope * B[k * nu + j];
        }
}

int nodes_derivatives(const scp_core *core, nodes of, const double *X, const double *U, double *p,
                      derivatives *D)
{
    int N = of.N, nx = core->at.nx, nu = core->at.nu, part = of.n * core->at.d;
    int m = (of.K - 1) * part, failed = 0;
    for (int i = 0; i < N; i++)
        slopes_of(core, X + (i + 1) * nx, D->at + i * part * nx);
    if (core->linear || of.K == 1)
        nodes_positions(core, of, X, U, p);
    for (int i = 0; core->linear && i < N && m; i++) {
        memcpy(D->C + i * m * nx, core->p.between_x, (size_t)(m * nx) * sizeof(double));
        memcpy(D->D + i * m * nu, core->p.between_u, (size_t)(m * nu) * sizeof(double));
    }
    if (core->linear || of.K == 1)
        return 0;
    arena *room = &mutable_core(core)->scratch;
    size_t used = room->used;
    double *after = doubles(room, (size_t)(N * nx)), *A = doubles(room, (size_t)(N * nx * nx));
    double *B = doubles(room, (size_t)(N * nx * nu)), *slopes = doubles(room, (size_t)(part * nx));
    for (int k = 1; k < of.K && !failed; k++) {
        failed = model_linearise(core, N, X, U, (double)k / of.K, after, A, B);
        for (int i = 0; i < N && !failed; i++) {
            int row = i * m + (k - 1) * part;
            bodies(core, after + i * nx, p + row + i * part);
            slopes_of(core, after + i * nx, slopes);
            chained(core, slopes, A + i * nx * nx, B + i * nx * nu, D->C + row * nx,
                    D->D + row * nu);
        }
    }
    for (int i = 0; i < N; i++)
        bodies(core, X + (i + 1) * nx, p + i * (m + part) + m);
    room->used = used;
    return failed;
}

/* The larger of a length and that from a to b (d,). */
static double longer(double than, int d, const double *a, const double *b)
{
    double sum = 0;
    for (int l = 0; l < d; l++)
        sum += (b[l] - a[l]) * (b[l] - a[l]);
    return larger(sqrt(sum), than);
}

static void linear_motion(const scp_core *core, nodes of, const double *X, const double *U,
                          motion *m)
{
    const scp_problem *p = &core->p;
    int d = core->at.d, nx = core->at.nx, nu = core->at.nu;
    const double none[3] = {0};
    for (int i = 0; i < of.N; i++) {
        double before[3], after[3], bend[3], chord = 0, most = 0;
        const double *x = X + i * nx, *u = U + i * nu;
        bodies(core, x, before);
        for (int k = 0; k < of.K; k++) {
            if (k < of.K - 1)
                both(d, nx, nu, p->between_x + k * d * nx, p->between_u + k * d * nu, x, u, after);
            else
                bodies(core, x + nx, after);
            chord = longer(chord, d, before, after);
            both(d, nx, nu, p->bend_x + k * d * nx, p->bend_u + k * d * nu, x, u, bend);
            most = longer(most, d, none, bend);
            memcpy(before, after, sizeof before);
        }
        m->chord[i] = chord;
        m->deviation[i] = most;
    }
}

/* Likewise, of any robot; `next` (n, d) is where the sample at an interval's end is, which need not
 * be where the interval leads. The way bends off its chord the most in the middle. */
static void bent_motion(const scp_core *core, nodes of, const double *X, const double *U, motion *m)
{
    arena *room = &mutable_core(core)->scratch;
    size_t used = room->used;
    int d = core->at.d, nx = core->at.nx, part = of.n * d;
    double *before = doubles(room, (size_t)(of.N * part));
    double *middle = doubles(room, (size_t)(of.N * part));
    double *after = doubles(room, (size_t)(of.N * part)), *next = doubles(room, (size_t)part);
    memset(m->chord, 0, (size_t)of.N * sizeof(double));
    memset(m->deviation, 0, (size_t)of.N * sizeof(double));
    positions_at(core, of, X, U, 0, part, before);
    for (int k = 0; k < of.K; k++) {
        positions_at(core, of, X, U, (2 * k + 1) / (2.0 * of.K), part, middle);
        positions_at(core, of, X, U, (2 * k + 2) / (2.0 * of.K), part, after);
        for (int i = 0; i < of.N; i++) {
            bodies(core, X + (i + 1) * nx, next);
            for (int at = 0; at < part; at += d) {
                double *a = before + i * part + at, *b = after + i * part + at, chord[3];
                m->chord[i] = longer(m->chord[i], d, a, k < of.K - 1 ? b : next + at);
                for (int l = 0; l < d; l++)
                    chord[l] = (a[l] + b[l]) / 2;
                m->deviation[i] = longer(m->deviation[i], d, chord, middle + i * part + at);
            }
        }
        double *swap = before;
        before = after, after = swap;
    }
    room->used = used;
}

void nodes_motion(const scp_core *core, nodes of, const double *X, const double *U, motion *m)
{
    if (core->linear) {
        linear_motion(core, of, X, U, m);
        return;
    }
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    for (int first = 0; first < of.N; first += N) {
        nodes some = of;
        some.N = of.N - first < N ? of.N - first : N;
        motion there = {m->chord + first, m->deviation + first};
        bent_motion(core, some, X + first * nx, U + first * nu, &there);
    }
}

/* The largest of a value and its neighbours, of two lists. */
static double widened(int N, const double *a, const double *b, int i)
{
    double most = larger(a[i], b[i]);
    if (i > 0)
        most = larger(most, larger(a[i - 1], b[i - 1]));
    if (i + 1 < N)
        most = larger(most, larger(a[i + 1], b[i + 1]));
    return most;
}

void nodes_reserved(nodes of, const motion *a, const motion *b, double least, motion *m)
{
    for (int i = 0; i < of.N; i++) {
        m->chord[i] = RESERVE * widened(of.N, a->chord, b->chord, i);
        m->deviation[i] = larger(RESERVE * widened(of.N, a->deviation, b->deviation, i), least);
    }
}

int nodes_cover(nodes of, const motion *assumed, const motion *own)
{
    for (int i = 0; i < of.N; i++)
        if (!(own->chord[i] <= assumed->chord[i] && own->deviation[i] <= assumed->deviation[i]))
            return 0;
    return 1;
}

void nodes_radii(nodes of, int J, const double *radii, const double *drift, const motion *m,
                 double *wide)
{
    for (int j = 0; j < J; j++, radii += of.size, drift += of.size, wide += of.size) {
        for (int i = 0; i < of.N; i++)
            for (int c = i * of.count; c < (i + 1) * of.count; c++) {
                double reach = radii[c] + m->deviation[i], half = (m->chord[i] + drift[c]) / 2;
                wide[c] = sqrt(reach * reach + half * half);
            }
        /* a sample also begins the next interval, and has to leave room for what happens there */
        for (int c = of.count; c < of.size; c += of.count)
            for (int disc = 0; disc < of.n; disc++)
                wide[c - of.n + disc] = larger(wide[c - of.n + disc], wide[c + disc]);
    }
}

/* Second derivative of forces' (n, d) p in the heading. */
static double sway_of(const scp_core *core, const double *x, const double *forces)
{
    double c = cos(x[core->p.heading]), s = sin(x[core->p.heading]), sum = 0;
    for (int k = 0; k < core->p.discs; k++)
        sum -= core->p.disc[k] * (forces[2 * k] * c + forces[2 * k + 1] * s);
    return sum;
}

/* Adds phi's second derivatives of the positions after a share of each interval. */
static void curvature_within(const scp_core *core, const double *X, const double *U,
                             const double *phi, int k, double *stages, double *bent)
{
    arena *room = &mutable_core(core)->scratch;
    size_t used = room->used;
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu, size = nx + nu, plain = is_plain(core);
    int part = core->p.discs * core->at.d, apart = core->at.nodes.count * core->at.d;
    double *pull = doubles(room, (size_t)(N * nx)), *after = doubles(room, (size_t)(N * nx));
    double *A = doubles(room, (size_t)(N * nx * nx)), *B = doubles(room, (size_t)(N * nx * nu));
    double *slopes = doubles(room, (size_t)(part * nx)), share = (double)k / core->p.instants;
    phi += (k - 1) * part;
    if (!plain && model_linearise(core, N, X, U, share, after, A, B)) {
        mutable_core(core)->broken = 1;
        room->used = used;
        return;
    }
    memset(pull, 0, (size_t)(N * nx) * sizeof(double));
    for (int i = 0; i < N; i++, phi += apart) {
        slopes_of(core, plain ? X : after + i * nx, slopes); /* at any state, if plain */
        for (int r = 0; r < part; r++)
            axpy(nx, phi[r], slopes + r * nx, pull + i * nx);
        if (plain)
            continue;
        double sway = sway_of(core, after + i * nx, phi);
        const double *by_x = A + (i * nx + core->p.heading) * nx;
        const double *by_u = B + (i * nx + core->p.heading) * nu;
        for (int r = 0; r < size; r++)
            for (int c = 0; c < size; c++)
                stages[(i * size + r) * size + c] += sway * (r < nx ? by_x[r] : by_u[r - nx])
                                                     * (c < nx ? by_x[c] : by_u[c - nx]);
    }
    if (model_curvature(core, N, X, U, pull, share, bent))
        mutable_core(core)->broken = 1;
    else
        axpy(N * size * size, 1, bent, stages);
    room->used = used;
}

int nodes_curvature(const scp_core *core, const double *X, const double *U, const double *nu,
                    const double *phi, double *stages, double *sway)
{
    arena *room = &mutable_core(core)->scratch;
    size_t used = room->used;
    const nodes *of = &core->at.nodes;
    int N = of->N, nx = core->at.nx, size = nx + core->at.nu;
    double *bent = doubles(room, (size_t)(N * size * size));
    if (model_curvature(core, N, X, U, nu, 1.0, stages)) {
        mutable_core(core)->broken = 1;
        memset(stages, 0, (size_t)(N * size * size) * sizeof(double));
    }
    for (int k = 1; k < of->K; k++)
        curvature_within(core, X, U, phi, k, stages, bent);
    room->used = used;
    if (is_plain(core))
        return 0;
    for (int i = 0; i < N; i++)
        sway[i] = sway_of(core, X + (i + 1) * nx,
                          phi + ((i + 1) * of->count - of->n) * core->at.d);
    return 1;
}

/* All that may be taken at once: in `curvature_within`, the deepest of all. */
size_t scratch_of_nodes(const scp_core *core)
{
    const layout *c = &core->at;
    int size = c->nx + c->nu, part = c->nodes.n * c->d, takes = 8;
    int most = c->N * (size * size + 2 * c->nx + c->nx * size + 3 * part) + part * (c->nx + 1);
    return ((size_t)most + 8 * (size_t)takes) * sizeof(double);
}
