/* The backup of a plan: its inputs, or a head of them, then braking to rest; scp_mpc/control/backup.py.
 *
 * A plan is checked up to its horizon only: it may end at speed, right in front of something. So the
 * way to rest from its end is checked, too, against the predictions carried on beyond their last row:
 *
 *     mean        goes on at the velocity of the last interval
 *     covariance  goes on growing in the directions in which it grew last, and never shrinks
 *
 * Most plans end far from everything: the ways and times that braking takes from some speeds on are
 * tried out beforehand.
 */
#include "core.h"
#include "small.h"

enum { SPEEDS = 8 };

static const double SECONDS = 4.0; /* of braking that are looked at, at least */
static const double FADED = 0.15;  /* [m/s] that is rest where braking fades out and does not end */
static const double RESERVE = 1.5; /* of way and time of braking over those straight on */

typedef struct {
    int horizon;         /* intervals that are looked at */
    int swings;          /* limited rates carry states on beyond bounds, and let braking swing */
    int bounded;         /* whether positions are */
    int known;           /* entries of the table: way [m] and time [s] over speeds [m/s] */
    double speed[SPEEDS + 1], way[SPEEDS + 1], time[SPEEDS + 1];
    double body;         /* [m] of the robot about its position */
    double *X, *U;       /* (horizon+1, nx), (horizon, nu) braking, then rest */
    double *deep;        /* (M, C) */
    double *means, *covariances, *stds, *radii; /* of near obstacles from a stage on */
    int *shape;
    step_room room;
} memory;

int backup_horizon(const scp_core *core)
{
    int late = (int)ceil(SECONDS / core->p.dt);
    return late > core->p.horizon ? late : core->p.horizon;
}

void lay_out_backup(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    const size_t late = (size_t)backup_horizon(core), M = (size_t)at->M, d = (size_t)at->d;
    memory *my = take(from, 1, sizeof *my), none;
    core->backup = my;
    if (!my)
        my = &none;
    my->X = doubles(from, (late + 1) * (size_t)at->nx);
    my->U = doubles(from, late * (size_t)at->nu);
    my->deep = doubles(from, M * late * (size_t)at->nodes.count);
    my->means = doubles(from, M * (late + 1) * d);
    my->covariances = doubles(from, M * (late + 1) * d * d);
    my->stds = doubles(from, M * (late + 1));
    my->radii = doubles(from, M);
    my->shape = ints(from, M);
    lay_out_room(core, from, nodes_of((int)late, at->nodes.K, at->nodes.n), &my->room);
}

size_t scratch_of_backup(const scp_core *core)
{
    (void)core;
    return 0;
}

/* ---- the table */

static double apart(const scp_core *core, const double *x, const double *other)
{
    double sum = 0;
    for (int l = 0; l < core->at.d; l++) {
        double way = x[core->p.position[l]] - other[core->p.position[l]];
        sum += way * way;
    }
    return sqrt(sum);
}

/* Whether so many inputs come to rest within the time that is looked at. */
static int rests(const scp_core *core, const memory *my, int steps)
{
    const double *end = my->X + steps * core->at.nx;
    return steps < my->horizon ||
           apart(core, end, end - core->at.nx) <= (my->swings ? AT_REST : FADED) * core->p.dt;
}

static int are_finite(int n, const double *x)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

/* How much a row of bounded states is about the position, and whether about anything else. */
static double about_position(const scp_core *core, int r, int *mixed)
{
    const double *row = core->p.row + r * core->at.nx;
    double sum = 0;
    *mixed = 0;
    for (int k = 0; k < core->at.nx; k++) {
        int is_position = 0;
        for (int l = 0; l < core->at.d; l++)
            is_position |= core->p.position[l] == k;
        sum += is_position ? row[k] * row[k] : 0;
        *mixed |= !is_position && row[k] != 0;
    }
    return sqrt(sum);
}

void set_up_backup(scp_core *core)
{
    const scp_problem *p = &core->p;
    memory *my = core->backup;
    int mixed;
    my->horizon = backup_horizon(core);
    my->swings = p->limits_rates && core->at.nb > 0;
    for (int r = 0; r < core->at.nb; r++)
        my->bounded |= about_position(core, r, &mixed) > 0;
    for (int k = 0; k < p->discs; k++)
        my->body = larger(fabs(p->disc[k]), my->body);
    my->body += p->robot_radius;
    my->known = 1; /* at rest there is nothing to brake */
    for (int k = 0; p->moving && k < SPEEDS; k++, my->known++) {
        int steps = braking(core, my->horizon, p->moving + k * core->at.nx, NULL, my->U, my->X);
        double most = 0;
        if (!are_finite((steps + 1) * core->at.nx, my->X) || !rests(core, my, steps))
            break;
        for (int i = 1; i <= steps; i++)
            most = larger(apart(core, my->X + i * core->at.nx, my->X), most);
        my->speed[my->known] = ldexp(0.125, k);
        my->way[my->known] = most;
        my->time[my->known] = steps * p->dt;
    }
}

int backup_always(const scp_core *core)
{
    const memory *my = core->backup;
    return my->swings || my->bounded;
}

static double interpolated(const memory *my, const double *part, double speed)
{
    int k = 1;
    while (k < my->known && my->speed[k] < speed)
        k++;
    if (k == my->known)
        return part[k - 1];
    double share = (speed - my->speed[k - 1]) / (my->speed[k] - my->speed[k - 1]);
    return part[k - 1] + share * (part[k] - part[k - 1]);
}

/* ---- obstacles beyond the horizon */

static double uniform_size(const scp_core *core, int count)
{
    const double *sizes = core->p.backup_sizes ? core->p.backup_sizes : core->p.sizes;
    return sizes ? sizes[count] : core->p.s_ref;
}

static double relative_size(const scp_core *core, int count)
{
    const double size = uniform_size(core, count), usual = core->p.s_ref;
    return size < usual || size > usual ? size / usual : 1;
}

/* Of an obstacle's body about its position, its radius included, and the robot's. */
static double reach_of(const scp_core *core, int j)
{
    const memory *my = core->backup;
    const int shape = core->given.shape[j];
    return my->body + core->given.radii[j] + (shape < 0 ? 0 : core->solids[shape].size);
}

/* The last row of an obstacle's prediction. */
static int last_row(const scp_core *core, int j) { return j * (core->at.N + 1) + core->at.N; }

static void mean_at(const scp_core *core, int j, int row, double *mean)
{
    const int d = core->at.d, N = core->at.N, beyond = row > N ? row - N : 0;
    const double *last = core->given.means + last_row(core, j) * d, *at = last + (row - N) * d;
    for (int l = 0; l < d; l++)
        mean[l] = beyond ? last[l] + beyond * (last[l] - last[l - d]) : at[l];
}

/* What the largest variance grows by in one interval beyond the last row, at most. */
static double growth(const scp_core *core, int j)
{
    const int width = core->at.d * core->at.d;
    const double *last = core->given.covariances + last_row(core, j) * width;
    double sum = 0;
    for (int k = 0; k < width; k++)
        sum += (last[k] - last[k - width]) * (last[k] - last[k - width]);
    return sqrt(sum);
}

/* The nearest positive semi-definite matrix to a symmetric one: itself if it is one. */
static void positive_part(int d, double *A)
{
    double values[3], V[9];
    eigen_small(d, A, values, V);
    for (int k = 0; values[0] < 0 && k < d; k++)
        for (int l = 0; l < d; l++) {
            A[k * d + l] = 0;
            for (int m = 0; m < d; m++)
                A[k * d + l] += V[k * d + m] * larger(values[m], 0.0) * V[l * d + m];
        }
}

/* A prediction from a stage on, carried on beyond its last row, as number k of those near. */
static void carry_on(const scp_core *core, int j, int stage, int stages, int k)
{
    memory *my = core->backup;
    const int d = core->at.d, N = core->at.N, width = d * d;
    const double *last = core->given.covariances + last_row(core, j) * width;
    double growing[9];
    for (int l = 0; l < width; l++)
        growing[l] = last[l] - last[l - width];
    positive_part(d, growing);
    for (int i = 0; i <= stages; i++) {
        const int row = stage + i, beyond = row > N ? row - N : 0, to = k * (stages + 1) + i;
        const double *Sigma = last + (beyond ? 0 : row - N) * width;
        mean_at(core, j, row, my->means + to * d);
        for (int l = 0; l < width; l++)
            my->covariances[to * width + l] = Sigma[l] + beyond * growing[l];
        my->stds[to] = beyond ? sqrt(larger(largest_variance(d, my->covariances + to * width), 0.0))
                              : core->given.largest_std[last_row(core, j) + row - N];
    }
    my->radii[k] = core->given.radii[j];
    my->shape[k] = core->given.shape[j];
}

/* ---- whether braking is clear */

/* Whether nothing can be met while braking from the end of a plan. */
static int is_far(const scp_core *core, const double *X)
{
    const memory *my = core->backup;
    const scp_problem *p = &core->p;
    const int N = core->at.N, nx = core->at.nx, d = core->at.d, J = core->given.J;
    const double *end = X + N * nx, size = uniform_size(core, J);
    double speed = apart(core, end, end - nx) / p->dt;
    if (!(speed <= my->speed[my->known - 1]) || my->swings)
        return 0;
    double way = RESERVE * interpolated(my, my->way, speed);
    double time = RESERVE * interpolated(my, my->time, speed);
    for (int r = 0, mixed; r < core->at.nb; r++) {
        double share = about_position(core, r, &mixed);
        double value = dot(nx, p->row + r * nx, end);
        if (share > 0 && (mixed || lesser(value - p->row_min[r], p->row_max[r] - value) < way * share))
            return 0;
    }
    for (int j = 0; j < J; j++) {
        const double *mean = core->given.means + last_row(core, j) * d;
        double away[3] = {0}, move[3] = {0}, std = core->given.largest_std[last_row(core, j)];
        for (int l = 0; l < d; l++)
            away[l] = end[p->position[l]] - mean[l];
        difference(d, mean, mean - d, move);
        double drift = sqrt(inner(d, move, move)) / p->dt;
        double variance = std * std + time / p->dt * growth(core, j);
        double gap = sqrt(inner(d, away, away)) - size * sqrt(variance) - reach_of(core, j);
        if (!(gap > way + drift * time))
            return 0;
    }
    return 1;
}

/* Whether an obstacle may be touched on the way (steps+1) of braking from a stage on. */
static int is_near(const scp_core *core, int j, int steps, int stage, double size)
{
    const memory *my = core->backup;
    const int d = core->at.d, N = core->at.N;
    const double grows = growth(core, j);
    double least = INFINITY, moved = 0, before[3] = {0};
    for (int i = 0; i <= steps; i++) {
        const double *x = my->X + i * core->at.nx;
        const int row = stage + i, beyond = row > N ? row - N : 0;
        double away[3] = {0}, way[3] = {0};
        double std = core->given.largest_std[last_row(core, j) + (beyond ? 0 : row - N)];
        mean_at(core, j, row, away);
        for (int l = 0; l < d; l++)
            away[l] = x[core->p.position[l]] - away[l];
        if (beyond)
            std = sqrt(std * std + beyond * grows);
        least = lesser(sqrt(inner(d, away, away)) - size * std, least);
        difference(d, away, before, way);
        moved = i ? larger(sqrt(inner(d, way, way)), moved) : 0;
        memcpy(before, away, sizeof before);
    }
    return least - (reach_of(core, j) + 2 * moved) < 0;
}

/* Whether braking, the first `steps` of our X and U, from a stage on keeps out of all obstacles and
 * within its bounds. */
static int is_clear(scp_core *core, int steps, int stage)
{
    memory *my = core->backup;
    const layout *at = &core->at;
    const int J = core->given.J, count = at->nodes.count;
    const int stages = steps + 1 < my->horizon ? steps + 1 : my->horizon; /* one more: how it ends */
    const double size = uniform_size(core, J);
    int near = 0;
    if (!are_finite(at->nx, my->X + steps * at->nx))
        return 0;
    if (steps == 0)
        return 1;
    if (!rests(core, my, steps) || row_excess(core, steps, my->X, 1) > core->p.tolerance)
        return 0;
    for (int j = 0; j < J; j++)
        if (is_near(core, j, steps, stage, size))
            carry_on(core, j, stage, stages, near++);
    if (!near)
        return 1;
    predictions later = {near, my->means, my->covariances, my->stds, my->radii, my->shape};
    step then;
    my->room.nodes = nodes_of(stages, at->nodes.K, at->nodes.n);
    predict(core, &later, NULL, relative_size(core, near), &my->room, &then);
    then.x0 = my->X;
    for (int i = steps; i < stages; i++)
        memcpy(my->U + i * at->nu, core->p.rest, (size_t)at->nu * sizeof(double));
    if (depths_of(core, &then, my->U, my->X, my->deep))
        return 0;
    for (int k = 0; k < near * stages * count; k++)
        if (k % (stages * count) < steps * count && !(my->deep[k] <= core->p.tolerance))
            return 0;
    return 1;
}

/* Inputs from the next step on, after which the robot can brake. */
int backup_of(scp_core *core, const double *X, const double *U, double *inputs)
{
    memory *my = core->backup;
    const int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    int tried = N + 1, found = is_far(core, X) ? N : 0;
    for (int part = 1; !found && part <= 8; part *= 2) {
        int stage = part < 8 && N / part > 1 ? N / part : 1;
        if (stage == tried)
            continue;
        tried = stage;
        int steps = braking(core, my->horizon, X + stage * nx, U + (stage - 1) * nu, my->U, my->X);
        found = is_clear(core, steps, stage) ? stage : 0;
    }
    for (int k = 0; k < (found - 1) * nu; k++)
        inputs[k] = U[nu + k];
    return found - 1;
}

/* Inputs of an earlier backup, its braking, then rest. */
int backup_continued(scp_core *core, const double *x, const double *inputs, int count, double *whole)
{
    memory *my = core->backup;
    const int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    const double *last = count ? inputs + (count - 1) * nu : core->plain.u_last;
    double *now = my->X, *next = my->X + nx;
    memcpy(now, x, (size_t)nx * sizeof *x);
    for (int i = 0; i < count; i++) {
        if (model_step(core, now, inputs + i * nu, next) || !are_finite(nx, next))
            return 0;
        memcpy(now, next, (size_t)nx * sizeof *next);
    }
    int steps = braking(core, my->horizon, now, last, my->U, my->X);
    if (!is_clear(core, steps, count))
        return 0;
    for (int i = 0; i < N; i++) {
        const double *from = i < count           ? inputs + i * nu
                             : i < count + steps ? my->U + (i - count) * nu
                                                 : core->p.rest;
        memcpy(whole + i * nu, from, (size_t)nu * sizeof *whole);
    }
    return 1;
}
