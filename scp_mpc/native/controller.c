/* One step of receding-horizon control: the solver with a memory of its last plan.
 * scp_mpc/control/mpc.py without its memory of obstacles, and iterate.py's shifts.
 *
 *     start = previous plan, shifted
 *     plan = solver
 *     backup = the plan, then braking to rest beyond its horizon; the last one, where this has none
 *     u0 within its bounds and a rate's reach, checked last; only then is anything remembered
 */
#include "core.h"

static const int AFRESH = 10;       /* steps of standing after which a plan is sought afresh */
static const double BETTER = 0.999; /* of the cost of standing: less than that is better */
static const double ROUNDING = 1e-9; /* by which a rate may exceed its bounds */
static const double TURN = 6.283185307179586;

typedef struct {
    scp_iterate last, last_free;
    double *applied;         /* (nu,) */
    double *backup, *whole;  /* (N, nu) what is left of one; it, with braking */
    scp_outputs other;       /* a plan that was found from nothing */
    result followed;
    int has_last, has_last_free, has_applied;
    int steps;               /* of the backup, -1 for none */
    int touching, standing;  /* steps in a row */
} controller;

static void lay_out_outputs(const scp_core *core, arena *from, scp_outputs *out)
{
    memset(out, 0, sizeof *out);
    lay_out_iterate(core, from, &out->plan);
    lay_out_iterate(core, from, &out->obstacle_free);
}

void lay_out_controller(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    controller *kept = take(from, 1, sizeof *kept), c;
    memset(&c, 0, sizeof c);
    lay_out_iterate(core, from, &c.last);
    lay_out_iterate(core, from, &c.last_free);
    c.applied = doubles(from, (size_t)at->nu);
    c.backup = doubles(from, (size_t)at->n);
    c.whole = doubles(from, (size_t)at->n);
    lay_out_outputs(core, from, &c.other);
    lay_out_result(core, from, &c.followed);
    core->memory = kept;
    if (kept != NULL)
        *kept = c;
}

size_t scratch_of_controller(const scp_core *core)
{
    return (size_t)(core->at.nx + 3 * core->at.nu) * sizeof(double) + 4 * 64;
}

/* ---- iterates in time */

/* Drop the first of some stages, of `size` entries each, and repeat the last one. */
static void shift(int stages, int size, double *values)
{
    memmove(values, values + size, (size_t)((stages - 1) * size) * sizeof *values);
}

void shift_iterate(const scp_core *core, scp_iterate *it)
{
    const layout *at = &core->at;
    int N = at->N, C = at->nodes.size, nx = at->nx;
    double *end = it->states + N * nx;
    shift(N + 1, nx, it->states);
    if (model_step(core, it->states + (N - 1) * nx, it->inputs + (N - 1) * at->nu, end))
        memcpy(end, end - nx, (size_t)nx * sizeof *end);
    shift(N, at->nu, it->inputs);
    for (int j = 0; j < at->M; j++) {
        shift(N, at->nodes.count, it->slack + j * C);
        shift(it->has_multipliers ? N : 1, at->nodes.count, it->obstacles + j * C);
        shift(it->has_multipliers ? N : 1, at->nodes.count, it->pins + j * C);
    }
    if (!it->has_multipliers)
        return;
    shift(N, nx, it->dynamics);
    shift(N, at->nu, it->input_bounds);
    shift(N, at->nb, it->state_bounds);
    if (at->rated)
        shift(N, at->nu, it->rates);
}

/* Turn an iterate's heading to within half a turn of that of the state now; whether it did. */
static int unwrap(const scp_core *core, scp_iterate *it)
{
    int heading = core->p.heading, nx = core->at.nx;
    if (heading < 0)
        return 0;
    double turns = nearbyint((core->in.x0[heading] - it->states[heading]) / TURN);
    for (int i = 0; i <= core->at.N && turns != 0; i++)
        it->states[i * nx + heading] += TURN * turns;
    return turns != 0;
}

static void unwrap_both(const scp_core *core, scp_iterate *it, scp_iterate *free)
{
    if (unwrap(core, it) && free != NULL)
        unwrap(core, free);
}

/* ---- a step without memory */

int scp_solve(scp_core *core, int guesses)
{
    scp_iterate *guess = guesses > 0 ? &core->guess : NULL;
    scp_iterate *free = guesses > 1 ? &core->guess_free : NULL;
    begin_clock(core);
    int wrong = read_step(core);
    if (wrong)
        return wrong;
    if (guess != NULL)
        unwrap_both(core, guess, free);
    ignore_alternatives(core);
    solve_step(core, guess, free, core->in.multi_start, core->in.brake_first);
    core->out.seconds = elapsed(core);
    return 0;
}

/* ---- a step with memory */

void scp_reset(scp_core *core)
{
    controller *c = core->memory;
    c->has_last = c->has_last_free = c->has_applied = 0;
    c->touching = c->standing = 0;
    c->steps = -1;
    core->out.replayed = 0;
    forget_alternatives(core);
    ignore_alternatives(core);
}

static int is_standing(const scp_core *core)
{
    return stands(core, core->out.plan.states);
}

/* Whether to look for a plan from nothing: the last one may be a bad optimum to stand in. After so
 * many steps of standing, and after twice as many each time. */
static int is_stuck(const scp_core *core)
{
    const controller *c = core->memory;
    int times = c->standing / AFRESH, rest = c->standing % AFRESH;
    return times > 0 && !rest && (times & (times - 1)) == 0 && is_standing(core);
}

static int is_fine(const scp_core *core)
{
    return is_ok(core->out.status) && !core->out.contact;
}

static void exchange(scp_core *core, scp_outputs *other)
{
    scp_outputs kept = core->out;
    core->out = *other;
    *other = kept;
    core->out.contact = kept.contact;
    core->out.replayed = kept.replayed;
    core->out.u0 = core->out.plan.inputs;
}

/* The solver from nothing, whose plan replaces the one that is there if it is better. */
static void seek_afresh(scp_core *core)
{
    controller *c = core->memory;
    int fine = is_fine(core);
    exchange(core, &c->other);
    solve_step(core, NULL, NULL, 1, 0);
    if (is_fine(core) && (!fine || core->out.cost < BETTER * c->other.cost))
        return;
    exchange(core, &c->other);
    forget_alternatives(core);
}

static void plan(scp_core *core)
{
    controller *c = core->memory;
    int due = c->touching % core->p.multi_start_interval == 0;
    scp_iterate *last = c->has_last ? &c->last : NULL;
    scp_iterate *free = c->has_last && c->has_last_free ? &c->last_free : NULL;
    if (last != NULL) {
        shift_iterate(core, last);
        if (free != NULL)
            shift_iterate(core, free);
        unwrap_both(core, last, free);
    }
    solve_step(core, last, free, due, core->out.replayed >= core->p.max_replayed);
    if (is_stuck(core) && allows(core, TASK_ITERATION))
        seek_afresh(core);
}

/* Follow the backup of an earlier plan. What ignores the obstacles stays, or is the plan that was
 * not followed. */
static void follow(scp_core *core, const result *earlier)
{
    scp_outputs *out = &core->out;
    if (!out->has_obstacle_free)
        copy_iterate(core, &out->plan, &out->obstacle_free);
    out->has_obstacle_free = 1;
    out->candidates = out->switched = 0;
    forget_alternatives(core);
    write_plan(core, earlier);
}

/* The backup of a plan; or that of an earlier plan, where it is clear and this is not. */
static void back_up(scp_core *core)
{
    controller *c = core->memory;
    const scp_outputs *out = &core->out;
    int n = core->at.n, nu = core->at.nu, steps = -1;
    if (is_ok(out->status))
        steps = backup_of(core, out->plan.states, out->plan.inputs, c->whole);
    if (steps < 0 && c->steps >= 0 &&
        backup_continued(core, core->in.x0, c->backup, c->steps, c->whole)) {
        judge_inputs(core, &core->plain, c->whole, SCP_PREVIOUS, &c->followed);
        if (is_ok(c->followed.status)) {
            follow(core, &c->followed);
            steps = c->steps > 0 ? c->steps - 1 : 0;
            memmove(c->whole, c->backup + nu, (size_t)(n - nu) * sizeof(double));
        }
    }
    c->steps = steps;
    memcpy(c->backup, c->whole, (size_t)n * sizeof(double));
}

/* Whether the input to apply is within its bounds and what rates allow. */
static int is_sound(scp_core *core)
{
    const scp_problem *p = &core->p;
    const double *u0 = core->out.u0;
    int sound = 1;
    size_t mark = core->scratch.used;
    double *lower = doubles(&core->scratch, (size_t)p->nu);
    double *upper = doubles(&core->scratch, (size_t)p->nu);
    if (p->limits_rates)
        reach(core, core->plain.u_last, lower, upper);
    for (int i = 0; i < p->nu; i++) {
        sound &= p->u_min[i] <= u0[i] && u0[i] <= p->u_max[i]; /* not NaN */
        if (p->limits_rates)
            sound &= lower[i] - ROUNDING <= u0[i] && u0[i] <= upper[i] + ROUNDING;
    }
    core->scratch.used = mark;
    return sound;
}

/* The last guard: brake instead of an input that must not be applied. */
static void brake_instead(scp_core *core)
{
    controller *c = core->memory;
    step alone = core->plain;
    alone.J = 0;
    judge_braking(core, &alone, SCP_FALLBACK, &c->followed);
    core->out.candidates = core->out.switched = core->out.has_obstacle_free = 0;
    write_plan(core, &c->followed);
    for (int i = 0; i < core->at.n; i++)
        if (isnan(core->out.plan.inputs[i]))
            core->out.plan.inputs[i] = 0.0;
    limited(core, core->at.N, core->out.plan.inputs, core->plain.u_last);
}

static void remember(scp_core *core, int sound)
{
    controller *c = core->memory;
    scp_outputs *out = &core->out;
    int touching = touches(core, &out->plan), old;
    c->touching = touching ? c->touching + 1 : 0;
    c->standing = touching && is_standing(core) ? c->standing + 1 : 0;
    old = out->status == SCP_PREVIOUS || out->status == SCP_BRAKING;
    out->replayed = old ? out->replayed + 1 : 0;
    memcpy(c->applied, out->u0, (size_t)core->at.nu * sizeof(double));
    c->has_applied = 1;
    c->has_last = sound;
    c->has_last_free = sound && out->has_obstacle_free;
    c->steps = sound ? c->steps : -1;
    if (sound)
        copy_iterate(core, &out->plan, &c->last);
    else
        forget_alternatives(core);
    if (c->has_last_free)
        copy_iterate(core, &out->obstacle_free, &c->last_free);
}

/* What a step brings; the input last applied is remembered where that is not told. */
static int read_with_memory(scp_core *core)
{
    const controller *c = core->memory;
    scp_inputs *in = &core->in;
    int borrowed = !in->has_u_last && core->p.limits_rates && c->has_applied;
    if (borrowed) {
        memcpy(in->u_last, c->applied, (size_t)core->at.nu * sizeof(double));
        in->has_u_last = 1;
    }
    int wrong = read_step(core);
    if (borrowed)
        in->has_u_last = 0;
    return wrong;
}

int scp_step(scp_core *core)
{
    controller *c = core->memory;
    const scp_inputs *in = &core->in;
    begin_clock(core);
    int wrong = read_with_memory(core);
    if (wrong)
        return wrong;
    shift_alternatives(core);
    plan(core);
    if ((in->count || backup_always(core)) && allows(core, TASK_BACKUP)) {
        lap began = mark_time(core);
        back_up(core);
        learn_time(core, TASK_BACKUP, began, 1);
    } else {
        c->steps = -1;
    }
    int sound = is_sound(core);
    if (!sound)
        brake_instead(core);
    remember(core, sound);
    core->out.seconds = elapsed(core);
    return 0;
}

/* Without predictions: brake, whatever is in the way. */
int scp_brake(scp_core *core)
{
    controller *c = core->memory;
    int count = core->in.count;
    core->in.count = 0;
    begin_clock(core);
    int wrong = read_with_memory(core);
    core->in.count = count;
    if (wrong)
        return wrong;
    ignore_alternatives(core);
    forget_alternatives(core);
    brake_instead(core);
    core->out.kkt = core->out.solved = core->out.ranked = core->out.cut = core->out.infeasible = 0;
    c->steps = -1;
    remember(core, 1);
    core->out.seconds = elapsed(core);
    return 0;
}

/* ---- memory */

int scp_backup(const scp_core *core, const double **inputs)
{
    const controller *c = core->memory;
    *inputs = c->backup;
    return c->steps;
}

static void memo_iterate(const scp_core *core, memo *m, scp_iterate *it)
{
    const layout *at = &core->at;
    size_t N = (size_t)at->N, nx = (size_t)at->nx, n = (size_t)at->n, slots = (size_t)at->most_pairs;
    memo_doubles(m, (N + 1) * nx, it->states);
    memo_doubles(m, n, it->inputs);
    memo_doubles(m, (size_t)at->M, it->s);
    memo_doubles(m, slots, it->slack);
    memo_ints(m, 1, &it->has_multipliers);
    memo_doubles(m, N * nx, it->dynamics);
    memo_doubles(m, n, it->input_bounds);
    memo_doubles(m, (size_t)at->M, it->margin);
    memo_doubles(m, slots, it->obstacles);
    memo_doubles(m, slots, it->pins);
    memo_doubles(m, N * (size_t)at->nb, it->state_bounds);
    memo_doubles(m, n, it->rates);
}

void memo_controller(scp_core *core, memo *m)
{
    controller *c = core->memory;
    memo_iterate(core, m, &c->last);
    memo_iterate(core, m, &c->last_free);
    memo_doubles(m, (size_t)core->at.nu, c->applied);
    memo_doubles(m, (size_t)core->at.n, c->backup);
    memo_ints(m, 1, &c->has_last);
    memo_ints(m, 1, &c->has_last_free);
    memo_ints(m, 1, &c->has_applied);
    memo_ints(m, 1, &c->steps);
    memo_ints(m, 1, &c->touching);
    memo_ints(m, 1, &c->standing);
    memo_ints(m, 1, &core->out.replayed);
}
