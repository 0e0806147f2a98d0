/* Set-up: a problem is checked, the core laid out in one block, the problem's arrays copied there. */
#include <limits.h>

#include "core.h"

#define MEMBERS(X)                                                                                 \
    X(version) X(model) X(horizon) X(nx) X(nu) X(dim) X(max_obstacles) X(instants) X(discs) X(dt)  \
    X(position) X(heading) X(velocity) X(velocities) X(A) X(B) X(stopping) X(between_x)            \
    X(between_u) X(bend_x) X(bend_u) X(most_deviation) X(wheelbase) X(rear) X(substeps) X(own)     \
    X(Q) X(R) X(Qf) X(rest) X(moving) X(u_min) X(u_max) X(limits_rates) X(du_min) X(du_max)        \
    X(rows) X(row) X(row_min) X(row_max) X(row_soft) X(robot_radius) X(disc) X(inflation)          \
    X(s_ref) X(s_min) X(s_max) X(s_weight) X(sizes) X(backup_sizes) X(joint_risk) X(growth_time)   \
    X(slack_weight) X(state_slack_weight) X(max_shapes) X(max_corners) X(max_faces) X(max_edges)   \
    X(tolerance) X(max_iterations) X(max_candidates) X(max_programs) X(max_replayed)               \
    X(multi_start) X(multi_start_interval) X(deadline) X(clock) X(clock_context)

#define NUMBER(name) NO_##name,
#define NAME(name) #name,

enum { NO_MEMBER, MEMBERS(NUMBER) ALL_MEMBERS };

static const char *const names[] = {"", MEMBERS(NAME)};

enum { MOST_COUNT = 1 << 20 }; /* of anything */

static const double LARGEST = 1e15;   /* float64 resolves no more than metres beyond */
static const double ASYMMETRY = 1e-9; /* of a weight, relative to its largest entry */
static const double MOST_NUMBERS = 1 << 27; /* of any array */
static const double SECONDS = 4.0;    /* that backups look at, at least */

/* ---- checks */

const char *scp_name(int member)
{
    return member > 0 && member < ALL_MEMBERS ? names[member] : "";
}

static int is_number(double x) { return fabs(x) <= LARGEST; } /* false for NaN */

static int is_count(int n, int least) { return n >= least && n <= MOST_COUNT; }

static int is_flag(int flag) { return flag == 0 || flag == 1; }

static int are_numbers(int n, const double *x)
{
    if (!x)
        return n == 0;
    for (int i = 0; i < n; i++)
        if (!is_number(x[i]))
            return 0;
    return 1;
}

static int are_sizes(int n, const double *x)
{
    for (int j = 0; x && j < n; j++)
        if (!(x[j] > 0 && is_number(x[j])))
            return 0;
    return 1;
}

/* Bounds may be infinite on their own side: `none` is minus infinity for lower ones. */
static int are_bounds(int n, const double *x, double none)
{
    for (int i = 0; i < n; i++)
        if (!x || !(x[i] == none || is_number(x[i])))
            return 0;
    return 1;
}

static int are_ordered(int n, const double *low, const double *high)
{
    for (int i = 0; i < n; i++)
        if (!(low[i] <= high[i]))
            return 0;
    return 1;
}

static int is_weight(int n, const double *W)
{
    if (!W || !are_numbers(n * n, W))
        return 0;
    double allowed = ASYMMETRY * largest_abs(n * n, W);
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++)
            if (fabs(W[i * n + j] - W[j * n + i]) > allowed || W[i * n + i] < -allowed)
                return 0;
    return 1;
}

static int are_places(int n, const int *place, int below)
{
    for (int i = 0; i < n; i++) {
        if (!place || place[i] < 0 || place[i] >= below)
            return 0;
        for (int j = 0; j < i; j++)
            if (place[i] == place[j])
                return 0;
    }
    return 1;
}

#define REQUIRE(condition, member)                                                                 \
    if (!(condition))                                                                              \
    return NO_##member

static int check_sizes(const scp_problem *p)
{
    REQUIRE(p->version == SCP_VERSION, version);
    REQUIRE((int)p->model >= SCP_LINEAR && p->model <= SCP_OWN_MODEL, model);
    REQUIRE(is_count(p->horizon, 1), horizon);
    REQUIRE(is_count(p->nx, 1) && (p->model != SCP_UNICYCLE || p->nx == 4) &&
                (p->model != SCP_BICYCLE || p->nx == 5), nx);
    REQUIRE(is_count(p->nu, 1) && (p->model == SCP_LINEAR || p->model == SCP_OWN_MODEL || p->nu == 2),
            nu);
    REQUIRE((p->dim == 2 || p->dim == 3) && p->dim <= p->nx, dim);
    REQUIRE(is_count(p->max_obstacles, 0), max_obstacles);
    REQUIRE(is_count(p->instants, 1), instants);
    REQUIRE(is_count(p->discs, 1) && (p->heading >= 0 || p->discs == 1), discs);
    REQUIRE(p->dt > 0 && is_number(p->dt), dt);
    REQUIRE(are_places(p->dim, p->position, p->nx), position);
    REQUIRE(p->heading >= -1 && p->heading < p->nx && (p->heading < 0 || p->dim == 2), heading);
    REQUIRE(p->velocities == 0 || p->velocities == 1 || p->velocities == p->dim, velocities);
    REQUIRE(are_places(p->velocities, p->velocity, p->nx), velocity);
    return 0;
}

/* Arrays have to fit into memory, and into an int's range. */
static int check_room(const scp_problem *p)
{
    double d = p->dim, M = p->max_obstacles, N = p->horizon, late = ceil(SECONDS / p->dt);
    double count = (double)p->instants * p->discs, rows = p->rows > 0 ? p->rows : 0;
    double nv = N * p->nu + M, ny = N * count * d + M + N * (2 * p->nu + rows);
    double stage = p->nx + p->nu;
    REQUIRE(nv * (ny + M) <= MOST_NUMBERS && N * count * (M + d) * d * stage <= MOST_NUMBERS &&
                N * stage * stage <= MOST_NUMBERS && N * p->nx * nv <= MOST_NUMBERS &&
                rows * p->nx <= MOST_NUMBERS, horizon);
    REQUIRE((late + N) * (count + 1) * (M + 1) * d * d <= MOST_NUMBERS &&
                (late + N) * stage <= MOST_NUMBERS, dt);
    return 0;
}

static int check_linear(const scp_problem *p)
{
    int within = (p->instants - 1) * p->dim, bends = p->instants > 1 ? p->instants * p->dim : 0;
    REQUIRE(are_numbers(p->nx * p->nx, p->A), A);
    REQUIRE(are_numbers(p->nx * p->nu, p->B), B);
    REQUIRE(are_numbers(p->nu * p->nx, p->stopping), stopping);
    REQUIRE(are_numbers(within * p->nx, p->between_x), between_x);
    REQUIRE(are_numbers(within * p->nu, p->between_u), between_u);
    REQUIRE(are_numbers(bends * p->nx, p->bend_x), bend_x);
    REQUIRE(are_numbers(bends * p->nu, p->bend_u), bend_u);
    REQUIRE(p->most_deviation >= 0 && is_number(p->most_deviation), most_deviation);
    return 0;
}

static int check_model(const scp_problem *p)
{
    if (p->model == SCP_LINEAR)
        return check_linear(p);
    if (p->model == SCP_BICYCLE) {
        REQUIRE(p->wheelbase > 0 && is_number(p->wheelbase), wheelbase);
        REQUIRE(is_number(p->rear), rear);
        REQUIRE(is_count(p->substeps, 1), substeps);
    }
    if (p->model == SCP_OWN_MODEL)
        REQUIRE(p->own.advance && p->own.linearise && p->own.curvature && p->own.stopping_input, own);
    return 0;
}

static int check_bounds(const scp_problem *p)
{
    int rated = p->limits_rates ? p->nu : 0, rows = p->rows;
    REQUIRE(is_weight(p->nx, p->Q), Q);
    REQUIRE(is_weight(p->nu, p->R), R);
    REQUIRE(is_weight(p->nx, p->Qf), Qf);
    REQUIRE(are_numbers(p->nu, p->rest), rest);
    REQUIRE(!p->moving || are_numbers(8 * p->nx, p->moving), moving);
    REQUIRE(are_numbers(p->nu, p->u_min), u_min);
    REQUIRE(are_numbers(p->nu, p->u_max) && are_ordered(p->nu, p->u_min, p->u_max), u_max);
    REQUIRE(is_flag(p->limits_rates), limits_rates);
    REQUIRE(are_bounds(rated, p->du_min, -INFINITY), du_min);
    REQUIRE(are_bounds(rated, p->du_max, INFINITY), du_max);
    for (int l = 0; l < rated; l++) { /* holding an input is allowed */
        REQUIRE(p->du_min[l] <= 0, du_min);
        REQUIRE(p->du_max[l] >= 0, du_max);
    }
    REQUIRE(is_count(rows, 0), rows);
    REQUIRE(are_numbers(rows * p->nx, p->row), row);
    REQUIRE(are_bounds(rows, p->row_min, -INFINITY), row_min);
    REQUIRE(are_bounds(rows, p->row_max, INFINITY) && are_ordered(rows, p->row_min, p->row_max),
            row_max);
    for (int r = 0; r < rows; r++)
        REQUIRE(p->row_soft && is_flag(p->row_soft[r]), row_soft);
    return 0;
}

static int check_obstacles(const scp_problem *p)
{
    REQUIRE(p->robot_radius >= 0 && is_number(p->robot_radius), robot_radius);
    REQUIRE(p->disc && are_numbers(p->discs, p->disc) && (p->heading >= 0 || p->disc[0] == 0), disc);
    REQUIRE((int)p->inflation >= SCP_EXACT && p->inflation <= SCP_AXES, inflation);
    REQUIRE(p->s_ref >= 0 && is_number(p->s_ref), s_ref);
    REQUIRE(p->s_min >= 0 && p->s_min <= p->s_ref, s_min);
    REQUIRE(p->s_max >= p->s_ref && is_number(p->s_max), s_max);
    REQUIRE(p->s_weight > 0 && is_number(p->s_weight), s_weight);
    int promises = p->s_ref > 0; /* that is what sizes are relative to */
    REQUIRE(!p->sizes || (promises && are_sizes(p->max_obstacles + 1, p->sizes)), sizes);
    REQUIRE(!p->backup_sizes || (promises && are_sizes(p->max_obstacles + 1, p->backup_sizes)),
            backup_sizes);
    REQUIRE(p->joint_risk >= 0 && p->joint_risk < 0.5 && (p->joint_risk == 0 || p->sizes),
            joint_risk);
    REQUIRE(p->growth_time >= 0 && is_number(p->growth_time), growth_time);
    REQUIRE(p->slack_weight > 0 && is_number(p->slack_weight), slack_weight);
    REQUIRE(p->state_slack_weight > 0 && is_number(p->state_slack_weight), state_slack_weight);
    int simplex = p->dim + 1, most = MOST_COUNT >> 5;
    REQUIRE(is_count(p->max_shapes, 0) && p->max_shapes <= most, max_shapes);
    if (p->max_shapes) {
        most /= p->max_shapes;
        REQUIRE(p->max_corners >= simplex && p->max_corners <= most, max_corners);
        REQUIRE(p->max_faces >= simplex && p->max_faces <= most, max_faces);
        REQUIRE(p->max_edges >= (p->dim == 3 ? 6 : 0) && p->max_edges <= most, max_edges);
    }
    return 0;
}

static int check_settings(const scp_problem *p)
{
    REQUIRE(p->tolerance > 0 && is_number(p->tolerance), tolerance);
    REQUIRE(p->max_iterations >= 1, max_iterations);
    REQUIRE(p->max_candidates >= 1, max_candidates);
    REQUIRE(p->max_programs >= 1, max_programs);
    REQUIRE(p->max_replayed >= 1, max_replayed);
    REQUIRE(is_flag(p->multi_start), multi_start);
    REQUIRE(p->multi_start_interval >= 1, multi_start_interval);
    REQUIRE(p->deadline >= 0 && is_number(p->deadline), deadline);
    return 0;
}

int scp_check(const scp_problem *p)
{
    static int (*const checks[])(const scp_problem *) = {check_sizes,  check_room,      check_model,
                                                         check_bounds, check_obstacles, check_settings};
    if (!p)
        return NO_version;
    for (size_t k = 0; k < sizeof checks / sizeof *checks; k++) {
        int wrong = checks[k](p);
        if (wrong)
            return wrong;
    }
    return 0;
}

/* ---- layout */

static layout layout_of(const scp_problem *p)
{
    layout at = {.N = p->horizon, .nx = p->nx, .nu = p->nu, .d = p->dim, .M = p->max_obstacles};
    at.nb = p->rows;
    at.nodes = nodes_of(at.N, p->instants, p->discs);
    /* A size that cannot shrink never moves: larger ones only cost more and leave less room. */
    at.moving = p->s_min < p->s_ref ? at.M : 0;
    at.n = at.N * at.nu;
    at.rated = p->limits_rates ? at.n : 0;
    at.s = at.p + at.nodes.size * at.d;
    at.u = at.s + at.M;
    at.du = at.u + at.n;
    at.z = at.du + at.rated;
    at.ny = at.z + at.N * at.nb;
    at.nv = at.n + at.moving;
    at.boxed = at.moving ? at.s : at.u;
    at.nf = at.ny - at.boxed;
    at.inputs = at.u - at.boxed;
    at.rates = at.du - at.boxed;
    at.states = at.z - at.boxed;
    at.most_pairs = at.M * at.nodes.size;
    return at;
}

static const void *copied(arena *from, const void *values, int count, size_t size)
{
    if (!values || !count)
        return NULL;
    void *copy = take(from, (size_t)count, size);
    return copy ? memcpy(copy, values, (size_t)count * size) : values; /* measured: the caller's */
}

static void copy_problem(scp_problem *p, arena *from)
{
    int nx = p->nx, nu = p->nu, d = p->dim, nb = p->rows, within = (p->instants - 1) * d;
    int linear = p->model == SCP_LINEAR, bends = p->instants > 1 ? p->instants * d : 0;
    int sizes = p->max_obstacles + 1;
#define COPY(name, count) p->name = copied(from, p->name, count, sizeof *p->name)
    COPY(position, d), COPY(velocity, p->velocities);
    COPY(A, linear * nx * nx), COPY(B, linear * nx * nu), COPY(stopping, linear * nu * nx);
    COPY(between_x, linear * within * nx), COPY(between_u, linear * within * nu);
    COPY(bend_x, linear * bends * nx), COPY(bend_u, linear * bends * nu);
    COPY(Q, nx * nx), COPY(R, nu * nu), COPY(Qf, nx * nx);
    COPY(rest, nu), COPY(moving, 8 * nx), COPY(u_min, nu), COPY(u_max, nu);
    COPY(du_min, p->limits_rates * nu), COPY(du_max, p->limits_rates * nu);
    COPY(row, nb * nx), COPY(row_min, nb), COPY(row_max, nb), COPY(row_soft, nb);
    COPY(disc, p->discs), COPY(sizes, sizes), COPY(backup_sizes, sizes);
#undef COPY
}

static void lay_out_inputs(scp_core *core, arena *from)
{
    const scp_problem *p = &core->p;
    size_t stages = (size_t)p->horizon + 1, nx = (size_t)p->nx, d = (size_t)p->dim;
    size_t M = (size_t)p->max_obstacles, shapes = (size_t)p->max_shapes;
    scp_inputs *in = &core->in;
    in->x0 = doubles(from, nx);
    in->x_ref = doubles(from, stages * nx);
    in->u_last = doubles(from, (size_t)p->nu);
    in->means = doubles(from, M * stages * d);
    in->covariances = doubles(from, M * stages * d * d);
    in->radii = doubles(from, M);
    in->shape = ints(from, M);
    in->corners = ints(from, shapes);
    in->faces = ints(from, shapes);
    in->edges = ints(from, shapes);
    in->corner = doubles(from, shapes * (size_t)p->max_corners * d);
    in->normal = doubles(from, shapes * (size_t)p->max_faces * d);
    in->offset = doubles(from, shapes * (size_t)p->max_faces);
    in->edge = ints(from, shapes * (size_t)p->max_edges * 2);
    in->robot_covariance = doubles(from, stages * d * d);
}

static size_t scratch_of(const scp_core *core)
{
    static size_t (*const parts[])(const scp_core *) = {
        scratch_of_step,          scratch_of_linalg,     scratch_of_nodes,  scratch_of_condensing,
        scratch_of_certificate,   scratch_of_loop,       scratch_of_newton, scratch_of_start,
        scratch_of_transcription, scratch_of_candidates, scratch_of_solver, scratch_of_multi_start,
        scratch_of_fallback,      scratch_of_backup,     scratch_of_riccati, scratch_of_controller};
    size_t sum = 4096; /* and what alignment takes */
    for (size_t k = 0; k < sizeof parts / sizeof *parts; k++)
        sum += parts[k](core) + 1024;
    return sum;
}

/* Everything but the core itself, which is at the beginning of its block. */
static void lay_out(scp_core *core, const scp_problem *problem, arena *from)
{
    core->p = *problem;
    copy_problem(&core->p, from);
    core->at = layout_of(problem);
    core->linear = problem->model == SCP_LINEAR;
    lay_out_inputs(core, from);
    lay_out_iterate(core, from, &core->out.plan);
    lay_out_iterate(core, from, &core->out.obstacle_free);
    lay_out_iterate(core, from, &core->guess);
    lay_out_iterate(core, from, &core->guess_free);
    lay_out_step(core, from);
    lay_out_condensing(core, from);
    lay_out_certificate(core, from);
    lay_out_active_set(core, from);
    lay_out_transcription(core, from);
    lay_out_loop(core, from);
    lay_out_newton(core, from);
    lay_out_multi_start(core, from);
    lay_out_backup(core, from);
    lay_out_solver(core, from);
    lay_out_controller(core, from);
    core->scratch.size = scratch_of(core);
    core->scratch.base = take(from, core->scratch.size, 1);
}

size_t scp_size(const scp_problem *problem)
{
    if (scp_check(problem))
        return 0;
    arena from = {0};
    scp_core core;
    memset(&core, 0, sizeof core);
    take(&from, 1, sizeof core);
    lay_out(&core, problem, &from);
    return from.used;
}

scp_core *scp_setup(const scp_problem *problem, void *block, size_t size)
{
    size_t needed = scp_size(problem);
    if (!needed || !block || size < needed || (uintptr_t)block % 64)
        return NULL;
    memset(block, 0, needed); /* all that is ever read of it then is the same from call to call */
    arena from = {.base = block, .size = needed};
    scp_core *core = take(&from, 1, sizeof *core);
    lay_out(core, problem, &from);
    for (int j = 0; j < core->at.M; j++)
        core->in.shape[j] = -1;
    core->in.multi_start = 1;
    core->out.u0 = core->out.plan.inputs;
    set_up_step(core);
    set_up_condensing(core);
    set_up_transcription(core);
    set_up_loop(core);
    set_up_backup(core);
    scp_reset(core);
    return core;
}

/* ---- access */

scp_inputs *scp_in(scp_core *core) { return &core->in; }

const scp_outputs *scp_out(const scp_core *core) { return &core->out; }

scp_iterate *scp_guess(scp_core *core) { return &core->guess; }

scp_iterate *scp_guess_free(scp_core *core) { return &core->guess_free; }
