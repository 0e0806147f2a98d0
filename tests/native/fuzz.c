/* The raw call from bytes: problems, inputs and calls, sound ones and mad ones.
 *
 * Whatever comes in, a call returns an error that has a name, and nothing has happened, or it finishes
 * with a status and, where it has a memory, with an input within its bounds. Nothing outside the
 * core's block is written or read: one end of it is at a page that nobody may touch. And each call is
 * made twice, by a core whose scratch was zero and by one whose scratch was NaN: the same bits.
 *
 *     clang -fsanitize=fuzzer,address,undefined -DFUZZER ...   libFuzzer
 *     fuzz SEED COUNT                                          as many random strings of bytes
 *     fuzz FILE                                                one that was kept
 */
#define _DEFAULT_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

#include "core.h"

#ifdef SCP_POISON
void __asan_unpoison_memory_region(const volatile void *begin, size_t size);
#else
#define __asan_unpoison_memory_region(address, size) ((void)0)
#endif

#define DEMAND(condition)                                                                          \
    do {                                                                                           \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition);                \
            abort();                                                                               \
        }                                                                                          \
    } while (0)

enum { PAGE = 4096, MOST_BYTES = 8 << 20, CANARY = 0x5c, ROOM = 4096 };

/* ---- bytes and what is made of them */

static const uint8_t *next, *end;
static int mad_problem, mad_inputs, mad; /* how often numbers are no sensible ones, of 256 */

static int byte(void) { return next < end ? *next++ : 200; }

static int below(int n) { return n > 0 ? byte() % n : 0; }

static int chance(int of_256) { return byte() < of_256; }

static double strange(void)
{
    static const double numbers[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e15, -1e15, 1e-308, 5e-324,
                                     -0.0, 0.0, 1.0, 1e8, -1e8, 1e-8, 1.0000000000000002};
    return numbers[below(16)];
}

/* Between -scale and scale, in 2^16 steps; or strange. */
static double number(double scale)
{
    if (mad && chance(mad))
        return strange();
    int bits = byte() << 8;
    return scale * (((bits | byte()) - 32768) / 32768.0);
}

static double positive(double scale) { return fabs(number(scale)) + (mad ? 0 : 1e-3); }

static void fill(int n, double *x, double scale)
{
    for (int i = 0; i < n; i++)
        x[i] = number(scale);
}

static int wild(int sound, int other) { return mad && chance(mad) ? other : sound; }

/* ---- memory with a wall at one of its ends */

typedef struct {
    char *pages, *block;
    size_t size, whole;
} walled;

static walled wall(size_t size, int at_the_end)
{
    walled w = {.size = size, .whole = (size + 3 * PAGE - 1) / PAGE * PAGE};
    w.pages = mmap(NULL, w.whole, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    DEMAND(w.pages != MAP_FAILED);
    memset(w.pages, CANARY, w.whole);
    size_t room = (size + 63) / 64 * 64;
    w.block = at_the_end ? w.pages + w.whole - PAGE - room : w.pages + PAGE;
    DEMAND(!mprotect(w.pages, PAGE, PROT_NONE));
    DEMAND(!mprotect(w.pages + w.whole - PAGE, PAGE, PROT_NONE));
    return w;
}

static void tear_down(walled *w)
{
    __asan_unpoison_memory_region(w->pages, w->whole);
    for (char *p = w->pages + PAGE; p < w->pages + w->whole - PAGE; p++)
        DEMAND((p >= w->block && p < w->block + w->size) || *p == CANARY);
    DEMAND(!munmap(w->pages, w->whole));
}

/* ---- a robot of the caller's own: a point with drag, that fails now and then */

static int fails; /* of 256 calls */

static int own_advance(void *context, int count, const double *x, const double *u, double share,
                       double *after)
{
    const scp_problem *p = context;
    int d = p->dim, nx = p->nx, nu = p->nu;
    double h = share * p->dt;
    for (int i = 0; i < count; i++, x += nx, u += nu, after += nx)
        for (int k = 0; k < d; k++) {
            after[k] = x[k] + h * x[d + k];
            after[d + k] = x[d + k] + h * (u[k] - 0.3 * x[d + k] * fabs(x[d + k]));
        }
    return fails && chance(fails);
}

static int own_linearise(void *context, int count, const double *x, const double *u, double share,
                         double *after, double *A, double *B)
{
    const scp_problem *p = context;
    int d = p->dim, nx = p->nx, nu = p->nu;
    double h = share * p->dt;
    memset(A, 0, sizeof(double) * (size_t)(count * nx * nx));
    memset(B, 0, sizeof(double) * (size_t)(count * nx * nu));
    for (int i = 0; i < count; i++, A += nx * nx, B += nx * nu)
        for (int k = 0; k < d; k++) {
            A[k * nx + k] = 1;
            A[k * nx + d + k] = h;
            A[(d + k) * nx + d + k] = 1 - 0.6 * h * fabs(x[i * nx + d + k]);
            B[(d + k) * nu + k] = fails && chance(fails) ? strange() : h;
        }
    return own_advance(context, count, x, u, share, after);
}

static int own_curvature(void *context, int count, const double *x, const double *u,
                         const double *costates, double share, double *bent)
{
    const scp_problem *p = context;
    int d = p->dim, nx = p->nx, n = nx + p->nu;
    (void)u;
    memset(bent, 0, sizeof(double) * (size_t)(count * n * n));
    for (int i = 0; i < count; i++)
        for (int k = 0; k < d; k++)
            bent[i * n * n + (d + k) * (n + 1)] =
                -0.6 * share * p->dt * costates[i * nx + d + k] * (x[i * nx + d + k] < 0 ? -1 : 1);
    return fails && chance(fails);
}

static int own_stop(void *context, const double *x, double *u)
{
    const scp_problem *p = context;
    for (int k = 0; k < p->dim; k++)
        u[k] = fails && chance(fails) ? strange() : -x[p->dim + k] / p->dt;
    return fails && chance(fails);
}

static double ticks, tick; /* a clock by which each look takes time */

static double now(void *context)
{
    (void)context;
    if (mad_inputs && chance(mad_inputs / 8))
        return strange();
    return ticks += tick;
}

/* ---- problems */

/* Room for all arrays: what a problem points to is followed during set-up only. */
typedef struct {
    int position[3], velocity[3];
    double A[64], B[32], stopping[32], between_x[96], between_u[48], bend_x[128], bend_u[64];
    double Q[64], R[16], Qf[64], rest[4], moving[64], u_min[4], u_max[4], du_min[4], du_max[4];
    double row[64], row_min[8], row_max[8], disc[4], sizes[8], backup_sizes[8];
    uint8_t row_soft[8];
} numbers;

static double ones[(1 << 20) + 1]; /* as long as any array that is allowed */

static void weight(int n, double *W, double scale)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++)
            W[i * n + j] = W[j * n + i] =
                i == j ? (chance(20) ? 0.0 : positive(scale)) : chance(40) ? number(0.3 * scale) : 0.0;
}

static void linear_robot(scp_problem *p, numbers *a, int order)
{
    int d = p->dim, nx = p->nx, nu = p->nu, K = p->instants <= 4 ? p->instants : 0;
    for (int k = 0; k < d; k++) { /* states order k .. */
        int at = order * k;
        for (int l = 0; l < order; l++) {
            a->A[(at + l) * nx + at + l] = 1;
            if (l + 1 < order)
                a->A[(at + l) * nx + at + l + 1] = p->dt;
        }
        a->B[(at + order - 1) * nu + k] = p->dt;
        a->B[at * nu + k] += order > 1 ? p->dt * p->dt / 2 : 0;
        a->stopping[k * nx + at + order - 1] = order > 1 ? 1 / p->dt : 0;
        for (int i = 0; i + 1 < K; i++) {
            double h = (i + 1) * p->dt / K, *by_x = a->between_x + (i * d + k) * nx;
            by_x[at] = 1;
            if (order > 1)
                by_x[at + 1] = h;
            a->between_u[(i * d + k) * nu + k] = order > 1 ? h * h / 2 : h;
        }
    }
    if (chance(60))
        fill(nx * nx, a->A, 1.5);
    if (chance(40))
        fill(nx * nu, a->B, 1.5);
    if (chance(60))
        fill(K * d * nx, a->bend_x, 0.1), fill(K * d * nu, a->bend_u, 0.1);
    p->most_deviation = positive(0.1);
    p->A = a->A, p->B = a->B, p->stopping = a->stopping;
    p->between_x = a->between_x, p->between_u = a->between_u;
    p->bend_x = a->bend_x, p->bend_u = a->bend_u;
}

static void robot(scp_problem *p, numbers *a)
{
    int order = 1 + below(2);
    p->model = (scp_model)wild(below(4), byte() - 128);
    p->dim = 2 + (p->model == SCP_LINEAR || p->model == SCP_OWN_MODEL ? below(2) : 0);
    p->heading = -1;
    int d = p->dim, stride = 1;
    if (p->model == SCP_UNICYCLE || p->model == SCP_BICYCLE) {
        p->nx = p->model == SCP_UNICYCLE ? 4 : 5;
        p->nu = 2, p->heading = 2, p->velocities = 1, a->velocity[0] = 3;
    } else {
        order = p->model == SCP_OWN_MODEL ? 2 : order;
        stride = p->model == SCP_OWN_MODEL ? 1 : order;
        p->nx = order * d, p->nu = d, p->velocities = order > 1 ? d : 0;
    }
    for (int k = 0; k < d; k++) {
        a->position[k] = wild(k * stride, byte() - 128);
        if (p->heading < 0)
            a->velocity[k] = wild(k * stride + (p->model == SCP_OWN_MODEL ? d : 1), byte() - 128);
    }
    p->position = a->position, p->velocity = a->velocity;
    p->wheelbase = positive(2), p->rear = number(1), p->substeps = wild(1 + below(3), byte() - 128);
    p->own = (scp_dynamics){p, own_advance, own_linearise, own_curvature, own_stop};
    if (p->model == SCP_LINEAR)
        linear_robot(p, a, order);
}

static void bounds(scp_problem *p, numbers *a)
{
    int nx = p->nx, nu = p->nu;
    for (int k = 0; k < nu; k++) {
        double half = chance(20) ? 0.0 : positive(5), middle = chance(40) ? number(1) : 0.0;
        a->u_min[k] = middle - half, a->u_max[k] = middle + half;
        a->rest[k] = chance(20) ? number(1) : 0.0;
        a->du_min[k] = chance(60) ? -INFINITY : -positive(2);
        a->du_max[k] = chance(60) ? INFINITY : positive(2);
    }
    p->u_min = a->u_min, p->u_max = a->u_max, p->rest = a->rest;
    p->limits_rates = wild(chance(80), byte());
    p->du_min = a->du_min, p->du_max = a->du_max;
    p->rows = wild(chance(100) ? below(6) : 0, byte() % 9);
    for (int r = 0; r < p->rows; r++) {
        if (chance(128))
            a->row[r * nx + r % nx] = 1;
        else
            fill(nx, a->row + r * nx, 1);
        a->row_min[r] = chance(60) ? -INFINITY : -positive(3);
        a->row_max[r] = chance(60) ? INFINITY : positive(3);
        a->row_soft[r] = (uint8_t)wild(below(2), byte());
    }
    p->row = a->row, p->row_min = a->row_min, p->row_max = a->row_max, p->row_soft = a->row_soft;
}

static void obstacles(scp_problem *p, numbers *a)
{
    p->robot_radius = chance(40) ? 0.0 : positive(0.5);
    for (int i = 0; i < p->discs && i < 4; i++)
        a->disc[i] = p->heading >= 0 && p->discs > 1 ? number(0.5) : 0.0;
    p->disc = a->disc;
    p->inflation = (scp_inflation)wild(below(2), byte() - 128);
    p->s_ref = positive(3);
    p->s_min = chance(128) ? p->s_ref : p->s_ref * fabs(number(1));
    p->s_max = p->s_ref + fabs(number(5));
    p->s_weight = positive(0.1);
    for (int j = 0; j < 8; j++)
        a->sizes[j] = positive(3), a->backup_sizes[j] = positive(3);
    p->sizes = chance(100) ? a->sizes : NULL;
    p->backup_sizes = p->sizes && chance(200) ? a->backup_sizes : NULL;
    p->joint_risk = p->sizes && chance(100) ? positive(0.4) : 0.0;
    p->growth_time = chance(60) ? positive(3) : 0.0;
    p->slack_weight = chance(60) ? positive(10) : 1e3;
    p->state_slack_weight = chance(60) ? positive(10) : 1e2;
    p->max_shapes = wild(chance(100) ? below(4) : 0, byte() - 128);
    p->max_corners = wild(p->dim + 1 + below(6), byte() - 128);
    p->max_faces = wild(p->dim + 1 + below(6), byte() - 128);
    p->max_edges = wild(6 + below(8), byte() - 128);
}

static void settings(scp_problem *p)
{
    static const double tolerances[] = {1e-6, 1e-10, 1e-3, 1e-15, 10};
    p->tolerance = mad && chance(mad) ? strange() : tolerances[below(5)];
    p->max_iterations = wild(1 + below(12), byte() - 128);
    p->max_candidates = wild(1 + below(4), byte() - 128);
    p->max_programs = wild(1 + below(40), byte() - 128);
    p->max_replayed = wild(1 + below(4), byte() - 128);
    p->multi_start = wild(below(2), byte());
    p->multi_start_interval = wild(1 + below(3), byte() - 128);
    p->deadline = chance(80) ? positive(0.2) : 0.0;
    p->clock = chance(128) ? now : NULL;
    tick = chance(128) ? 1e-4 : 1e-2;
}

static void make_problem(scp_problem *p, numbers *a)
{
    memset(p, 0, sizeof *p), memset(a, 0, sizeof *a);
    mad = mad_problem;
    p->version = wild(SCP_VERSION, byte());
    p->horizon = wild(1 + below(9), (byte() - 128) * 4096);
    p->max_obstacles = wild(below(6), (byte() - 128) * 16384);
    p->instants = wild(1 + below(4), byte() - 128);
    p->dt = chance(128) ? 0.2 : positive(0.5);
    robot(p, a);
    p->discs = wild(p->heading >= 0 ? 1 + below(3) : 1, byte() - 128);
    weight(p->nx, a->Q, 1), weight(p->nu, a->R, 0.1), weight(p->nx, a->Qf, 2);
    p->Q = a->Q, p->R = a->R, p->Qf = chance(128) ? a->Q : a->Qf;
    for (int i = 0; i < 8; i++)
        a->moving[i * p->nx + (p->velocities ? a->velocity[0] & 3 : 0)] = ldexp(1, i - 3);
    p->moving = chance(200) ? a->moving : NULL;
    bounds(p, a), obstacles(p, a), settings(p);
    if (p->instants > 4)
        p->between_x = p->between_u = p->bend_x = p->bend_u = ones;
    if (p->discs > 4)
        p->disc = ones;
    if (p->max_obstacles > 7 && p->sizes)
        p->sizes = p->backup_sizes = ones;
    if (mad && chance(mad)) /* an array is not there */
        *(const double **[]){&p->Q, &p->R, &p->u_min, &p->A, &p->row, &p->disc, &p->rest,
                             &p->between_x}[below(8)] = NULL;
}

/* ---- inputs */

static void box(const scp_problem *p, scp_inputs *in, int k)
{
    int d = p->dim, corners = 1 << d, faces = 2 * d, edges = d == 3 ? 12 : 0;
    if (corners > p->max_corners || faces > p->max_faces || edges > p->max_edges) {
        in->corners[k] = in->faces[k] = d + 1; /* a simplex */
        in->edges[k] = d == 3 ? 6 : 0;
        corners = faces = d + 1, edges = in->edges[k];
    }
    in->corners[k] = wild(corners, byte() - 128), in->faces[k] = wild(faces, byte() - 128);
    in->edges[k] = wild(edges, byte() - 128);
    double *corner = in->corner + k * p->max_corners * d, *normal = in->normal + k * p->max_faces * d;
    double *offset = in->offset + k * p->max_faces, half[3];
    int *edge = in->edge + 2 * k * p->max_edges, e = 0;
    for (int i = 0; i < d; i++)
        half[i] = positive(2);
    memset(normal, 0, sizeof(double) * (size_t)(p->max_faces * d));
    if (corners == d + 1) {
        memset(corner, 0, sizeof(double) * (size_t)(corners * d));
        for (int i = 0; i < d; i++) {
            corner[(i + 1) * d + i] = half[0];
            normal[i * d + i] = -1, offset[i] = 0;
            normal[d * d + i] = 1 / sqrt(d);
        }
        offset[d] = half[0] / sqrt(d);
    } else {
        static const int around[4] = {0, 1, 3, 2};
        for (int i = 0; i < corners; i++)
            for (int l = 0; l < d; l++)
                corner[i * d + l] = (((d == 2 ? around[i] : i) >> l) & 1 ? 1 : -1) * half[l];
        for (int i = 0; i < faces; i++)
            normal[i * d + i / 2] = i % 2 ? -1 : 1, offset[i] = half[i / 2];
    }
    for (int i = 0; d == 3 && i < corners; i++)
        for (int j = 0; j < i && e < edges; j++)
            if (corners == d + 1 || (((i ^ j) & ((i ^ j) - 1)) == 0))
                edge[2 * e] = wild(j, byte() - 128), edge[2 * e + 1] = i, e++;
    if (mad && chance(mad))
        corner[below(corners * d)] = strange();
    if (mad && chance(mad))
        normal[below(faces * d)] = strange();
}

/* Sound ones are roots times their transposes; singular where a root has a zero column. */
static void covariance(int d, double *S, double scale)
{
    double L[9];
    fill(d * d, L, scale);
    for (int k = 0; k < d; k++)
        if (chance(30))
            for (int i = 0; i < d; i++)
                L[i * d + k] = 0;
    for (int i = 0; i < d; i++)
        for (int j = 0; j < d; j++) {
            S[i * d + j] = 0;
            for (int k = 0; k < d; k++)
                S[i * d + j] += L[i * d + k] * L[j * d + k];
        }
    if (mad && chance(mad))
        S[below(d * d)] = chance(128) ? strange() : number(1); /* not symmetric, indefinite */
}

static void obstacle(const scp_problem *p, scp_inputs *in, int j)
{
    int N = p->horizon, d = p->dim;
    double *mean = in->means + j * (N + 1) * d, *S = in->covariances + j * (N + 1) * d * d, way[3];
    fill(d, mean, chance(60) ? 0.3 : 4), fill(d, way, 0.3);
    covariance(d, S, chance(128) ? 0.2 : 1);
    for (int i = 1; i <= N; i++)
        for (int k = 0; k < d; k++) {
            mean[i * d + k] = mean[(i - 1) * d + k] + way[k];
            for (int l = 0; l < d; l++)
                S[(i * d + k) * d + l] = S[k * d + l] * (1 + 0.05 * i);
        }
    if (mad && chance(mad))
        mean[below((N + 1) * d)] = strange();
    if (chance(20))
        covariance(d, S + below(N + 1) * d * d, 0.5);
    in->radii[j] = chance(60) ? 0.0 : positive(0.5);
    in->shape[j] = in->shapes > 0 && chance(128) ? below(in->shapes) : wild(-1, byte() - 128);
    if (j && chance(20)) /* one that is there twice */
        memcpy(mean, in->means, sizeof(double) * (size_t)((N + 1) * d));
}

static void make_inputs(const scp_problem *p, scp_inputs *in)
{
    int N = p->horizon, d = p->dim, M = p->max_obstacles;
    mad = mad_inputs;
    fill(p->nx, in->x0, chance(60) ? 0.01 : 2);
    fill(p->nx, in->x_ref, 5);
    for (int i = 1; i <= N; i++)
        for (int k = 0; k < p->nx; k++)
            in->x_ref[i * p->nx + k] = chance(10) ? number(8) : in->x_ref[(i - 1) * p->nx + k];
    fill(p->nu, in->u_last, 3);
    in->has_u_last = wild(below(2), byte());
    in->shapes = wild(p->max_shapes ? below(p->max_shapes + 1) : 0, byte() - 128);
    for (int k = 0; k < in->shapes && k < p->max_shapes; k++)
        box(p, in, k);
    in->count = wild(M ? below(M + 1) : 0, (byte() - 128) * 1024);
    for (int j = 0; j < in->count && j < M; j++)
        obstacle(p, in, j);
    in->has_robot_covariance = wild(chance(40), byte());
    for (int i = 0; i <= N; i++)
        covariance(d, in->robot_covariance + i * d * d, 0.1);
    in->multi_start = wild(!chance(60), byte());
    in->brake_first = wild(chance(40), byte());
}

static void copy_inputs(const scp_problem *p, const scp_inputs *from, scp_inputs *to)
{
    size_t N = (size_t)p->horizon + 1, d = (size_t)p->dim, M = (size_t)p->max_obstacles;
    size_t P = (size_t)p->max_shapes, whole = sizeof(int), real = sizeof(double);
    scp_inputs at = *to;
#define COPY(name, size) memcpy(at.name, from->name, size)
    COPY(x0, (size_t)p->nx * real), COPY(x_ref, N * (size_t)p->nx * real);
    COPY(u_last, (size_t)p->nu * real), COPY(means, M * N * d * real);
    COPY(covariances, M * N * d * d * real), COPY(radii, M * real), COPY(shape, M * whole);
    COPY(corners, P * whole), COPY(faces, P * whole), COPY(edges, P * whole);
    COPY(corner, P * (size_t)p->max_corners * d * real);
    COPY(normal, P * (size_t)p->max_faces * d * real);
    COPY(offset, P * (size_t)p->max_faces * real);
    COPY(edge, P * (size_t)p->max_edges * 2 * whole);
    COPY(robot_covariance, N * d * d * real);
#undef COPY
    to->has_u_last = from->has_u_last, to->count = from->count, to->shapes = from->shapes;
    to->has_robot_covariance = from->has_robot_covariance;
    to->multi_start = from->multi_start, to->brake_first = from->brake_first;
}

/* ---- calls */

typedef struct {
    int code, status, iterations, candidates;
    double cost, merit, numbers[ROOM];
    int count;
} outcome;

static void look(const scp_problem *p, const scp_core *core, outcome *o)
{
    const scp_outputs *out = scp_out(core);
    size_t states = (size_t)((p->horizon + 1) * p->nx), inputs = (size_t)(p->horizon * p->nu);
    o->status = (int)out->status, o->iterations = out->iterations, o->candidates = out->candidates;
    o->cost = out->cost, o->merit = out->merit;
    o->count = (int)(states + inputs);
    DEMAND(o->count <= ROOM);
    memcpy(o->numbers, out->plan.states, states * sizeof(double));
    memcpy(o->numbers + states, out->plan.inputs, inputs * sizeof(double));
}

static int alike(const outcome *a, const outcome *b)
{
    return a->code == b->code && a->status == b->status && a->iterations == b->iterations &&
           a->candidates == b->candidates && !memcmp(&a->cost, &b->cost, sizeof(double)) &&
           !memcmp(&a->merit, &b->merit, sizeof(double)) &&
           !memcmp(a->numbers, b->numbers, (size_t)a->count * sizeof(double));
}

/* Where to start from: the last plan, some of it strange. */
static void make_guess(const scp_problem *p, const scp_core *core, scp_iterate *to)
{
    const scp_iterate *last = &scp_out(core)->plan;
    size_t nx = (size_t)p->nx, nu = (size_t)p->nu, N = (size_t)p->horizon;
    memcpy(to->states, last->states, (N + 1) * nx * sizeof(double));
    memcpy(to->inputs, last->inputs, N * nu * sizeof(double));
    memcpy(to->s, last->s, (size_t)p->max_obstacles * sizeof(double));
    mad = mad_inputs;
    to->has_multipliers = wild(below(2), byte());
    if (chance(60))
        fill((int)(N * nu), to->inputs, 5);
    if (chance(60))
        fill((int)(N * nx), to->dynamics, 5), fill((int)(N * nu), to->input_bounds, 5);
    if (chance(60) && p->max_obstacles)
        fill(p->max_obstacles * p->horizon, to->obstacles, 10);
}

static void copy_guess(const scp_problem *p, const scp_iterate *from, scp_iterate *to)
{
    size_t nx = (size_t)p->nx, nu = (size_t)p->nu, N = (size_t)p->horizon, real = sizeof(double);
    size_t M = (size_t)p->max_obstacles;
    memcpy(to->states, from->states, (N + 1) * nx * real);
    memcpy(to->inputs, from->inputs, N * nu * real);
    memcpy(to->s, from->s, M * real);
    memcpy(to->dynamics, from->dynamics, N * nx * real);
    memcpy(to->input_bounds, from->input_bounds, N * nu * real);
    memcpy(to->obstacles, from->obstacles, M * N * real);
    to->has_multipliers = from->has_multipliers;
}

static void call(scp_core *core, int kind, int guesses, int dirt, outcome *o)
{
    __asan_unpoison_memory_region(core->scratch.base, core->scratch.size);
    memset(core->scratch.base, dirt, core->scratch.size);
    o->code = 0;
    if (kind == 0)
        o->code = scp_solve(core, guesses);
    else if (kind == 1)
        scp_reset(core);
    else if (kind == 2)
        o->code = scp_brake(core);
    else
        o->code = scp_step(core);
}

static void check(const scp_problem *p, const scp_core *core, int kind, const outcome *before,
                  const outcome *after)
{
    const scp_outputs *out = scp_out(core);
    if (after->code) {
        outcome same = *after;
        same.code = before->code;
        DEMAND(after->code > 0 && scp_input_name(after->code)[0]);
        DEMAND(alike(before, &same)); /* nothing happened */
        return;
    }
    DEMAND(after->status >= SCP_CONVERGED && after->status <= SCP_FALLBACK);
    DEMAND(out->candidates >= 0 && out->candidates <= SCP_MOST_CANDIDATES);
    for (int k = 0; k < p->nu && kind >= 2; k++)
        DEMAND(out->u0[k] >= p->u_min[k] && out->u0[k] <= p->u_max[k]);
}

/* The same calls to two cores; the strings of bytes are read once more for the second one. */
static void play(const scp_problem *p, scp_core *one, scp_core *other)
{
    static outcome before, first, second;
    int rounds = 1 + below(5);
    look(p, one, &before);
    for (int i = 0; i < rounds; i++) {
        int kind = below(10), guesses = below(3);
        make_inputs(p, scp_in(one));
        if (guesses > 0)
            make_guess(p, one, scp_guess(one)), copy_guess(p, scp_guess(one), scp_guess(other));
        if (guesses > 1)
            make_guess(p, one, scp_guess_free(one)),
                copy_guess(p, scp_guess_free(one), scp_guess_free(other));
        copy_inputs(p, scp_in(one), scp_in(other));
        const uint8_t *here = next;
        double then = ticks;
        call(one, kind, guesses, 0x00, &first);
        look(p, one, &first);
        next = here, ticks = then;
        call(other, kind, guesses, 0xff, &second);
        look(p, other, &second);
        DEMAND(alike(&first, &second));
        if (kind != 1)
            check(p, one, kind, &before, &first);
        before = first;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const int often[] = {0, 0, 0, 1, 3, 10};
    scp_problem p;
    numbers a;
    next = data, end = data + size;
    ticks = 0;
    for (size_t i = sizeof ones / sizeof *ones; ones[0] == 0 && i > 0; i--)
        ones[i - 1] = 1;
    mad_problem = often[below(6)], mad_inputs = often[below(6)], fails = often[below(6)];
    make_problem(&p, &a);
    int wrong = scp_check(&p), at_the_end = below(2);
    size_t bytes = scp_size(&p);
    DEMAND(!bytes == !!wrong && (!wrong || scp_name(wrong)[0]));
    if (wrong || bytes > MOST_BYTES || (p.horizon + 1) * (p.nx + p.nu) > ROOM)
        return 0;
    walled one = wall(bytes, at_the_end), other = wall(bytes, !at_the_end);
    DEMAND(!scp_setup(&p, one.block, bytes - 1) && !scp_setup(&p, one.block + 8, bytes));
    scp_core *first = scp_setup(&p, one.block, bytes), *second = scp_setup(&p, other.block, bytes);
    DEMAND(first && second);
    play(&p, first, second);
    tear_down(&one), tear_down(&other);
    return 0;
}

#ifndef FUZZER

static uint64_t state;

static uint8_t random_byte(void) /* xorshift64* */
{
    state ^= state >> 12, state ^= state << 25, state ^= state >> 27;
    return (uint8_t)((state * 2685821657736338717u) >> 56);
}

int main(int count, char **words)
{
    static uint8_t data[1 << 16];
    size_t size = 0;
    FILE *file = count == 2 ? fopen(words[1], "rb") : NULL;
    if (file) {
        size = fread(data, 1, sizeof data, file);
        fclose(file);
        return LLVMFuzzerTestOneInput(data, size);
    }
    DEMAND(count == 3);
    unsigned long seed = strtoul(words[1], NULL, 10), many = strtoul(words[2], NULL, 10);
    for (unsigned long k = seed; k < seed + many; k++) {
        state = 88172645463325252u + 0x9e3779b97f4a7c15u * k;
        size = 64 + (size_t)(random_byte() << 4);
        for (size_t i = 0; i < size; i++)
            data[i] = random_byte();
        if (getenv("FUZZ_TELL"))
            fprintf(stderr, "%lu\n", k);
        LLVMFuzzerTestOneInput(data, size);
    }
    return 0;
}

#endif
