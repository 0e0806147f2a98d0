/* The solver of one control step: puts the loop, its starts and what lies below it together.
 * scp_mpc/scp/solver.py, risk_allocation.py.
 *
 *     free plan, which ignores the obstacles: if it is clear of them, nothing can be better; a
 *                  nonlinear robot that would stand short of its goal tries some manoeuvres first
 *     start = previous plan, shifted (or the free plan)
 *     loop         until the KKT residual of the original problem is below the tolerance, or the
 *                  time is up
 *     multi-start  where an obstacle shapes the plan, the same from paths on its other sides;
 *                  the best plan wins, if by enough
 *     allocate     where a joint risk is promised, give it to those who need it, and go on
 *     fallback     without a plan that meets every constraint, the previous one, or braking, or
 *                  what is no faster than braking where it violates one
 *
 * Between the nodes of a plan radii leave room for what its motion there is assumed to be; a plan
 * that moves otherwise is sought again, with what it does for the assumption. */
#include "core.h"

enum {
    CORRECTIONS = 4, /* of what was assumed about the motion between nodes */
    MANOEUVRES = 4,  /* that are followed */
    SPARE = 10,      /* iterations for which there has to be time */
    ALLOCATIONS = 6  /* of risk */
};
static const double BETTER = 1e-3; /* share of the merit by which one has to win */
static const double GAIN = 0.001;  /* share of the cost that makes another allocation worth while */
static const double EVEN = 0.1;    /* of the joint risk that is spread evenly */

typedef struct {
    result free, best, known, end;
    nominal start;
    double *about;    /* (ny,) */
    double *path;     /* (C+1, d) of the plan that ignores the obstacles */
    double *starts;   /* (1 + MANOEUVRES, N nu) */
    motion free_motion, assumed, own;
    double *risks, *used; /* (M, C) */
    step scaled;
} solver_room;

static motion lay_out_motion(const scp_core *core, arena *from)
{
    motion m;
    m.chord = doubles(from, (size_t)core->at.N);
    m.deviation = doubles(from, (size_t)core->at.N);
    return m;
}

void lay_out_solver(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    solver_room *kept = take(from, 1, sizeof *kept), room;
    size_t risks = core->p.joint_risk > 0 ? (size_t)at->most_pairs : 0;
    memset(&room, 0, sizeof room);
    lay_out_result(core, from, &room.free);
    lay_out_result(core, from, &room.best);
    lay_out_result(core, from, &room.known);
    lay_out_result(core, from, &room.end);
    lay_out_nominal(core, from, &room.start);
    room.about = doubles(from, (size_t)at->ny);
    room.path = doubles(from, (size_t)((at->nodes.size + 1) * at->d));
    room.starts = doubles(from, (size_t)((1 + MANOEUVRES) * at->n));
    room.free_motion = lay_out_motion(core, from);
    room.assumed = lay_out_motion(core, from);
    room.own = lay_out_motion(core, from);
    room.risks = doubles(from, risks);
    room.used = doubles(from, risks);
    core->solver = kept;
    if (kept != NULL)
        *kept = room;
}

size_t scratch_of_solver(const scp_core *core)
{
    const layout *at = &core->at;
    size_t reals = (size_t)(2 * at->most_pairs + at->nodes.size * at->d + (at->N + 1) * at->nx +
                            2 * at->N);
    return reals * sizeof(double) + 8 * 64;
}

static void exchange(result *one, result *other)
{
    result kept = *one;
    *one = *other;
    *other = kept;
}

/* ---- between the nodes */

static void motion_of(const scp_core *core, const scp_iterate *it, motion *m)
{
    nodes_motion(core, core->at.nodes, it->states, it->inputs, m);
}

/* The step's radii leave room for what happens between the nodes, if anything does. */
static void widen(scp_core *core, const motion *m)
{
    core->now = &core->plain;
    if (core->at.nodes.K == 1 || !core->plain.J)
        return;
    core->now = &core->wide;
    nodes_radii(core->at.nodes, core->plain.J, core->plain.radii, core->plain.drift, m,
                core->wide.radii);
}

/* How deep a plan enters the no-go sets (J, C), for what it does between its nodes; the most. */
static double depths_between(scp_core *core, const result *best, double *deep)
{
    const layout *at = &core->at;
    solver_room *room = core->solver;
    int count = core->plain.J * at->nodes.size;
    size_t mark = core->scratch.used;
    double *path = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    step wide = core->plain;
    wide.radii = doubles(&core->scratch, (size_t)at->most_pairs);
    motion_of(core, &best->it, &room->own);
    nodes_radii(at->nodes, wide.J, core->plain.radii, core->plain.drift, &room->own, wide.radii);
    nodes_positions(core, at->nodes, best->it.states, best->it.inputs, path);
    depths(core, &wide, path, best->it.s, deep);
    core->scratch.used = mark;
    return largest_abs(count, deep);
}

/* Whether a plan is clear between its nodes, too, for what it really does there. */
static int is_kept(scp_core *core, const motion *assumed, const result *best)
{
    solver_room *room = core->solver;
    if (!is_ok(best->status))
        return 1;
    motion_of(core, &best->it, &room->own);
    if (nodes_cover(core->at.nodes, assumed, &room->own))
        return 1;
    size_t mark = core->scratch.used;
    double *deep = doubles(&core->scratch, (size_t)core->at.most_pairs);
    double most = depths_between(core, best, deep);
    core->scratch.used = mark;
    return most <= core->p.tolerance;
}

/* A plan that is not clear between its nodes after all says how far it is not. */
static void expose(scp_core *core, result *best)
{
    best->kkt.feasibility = depths_between(core, best, best->it.slack);
    best->status = SCP_VIOLATING;
}

/* ---- the plan that ignores the obstacles */

/* Inputs that lead near some local optima each: rest, and the best manoeuvres; how many. */
static int starts(scp_core *core)
{
    const solver_room *room = core->solver;
    int count = 0;
    for (int i = 0; i < core->at.n; i++)
        room->starts[i] = core->p.rest[i % core->at.nu];
    if (!core->linear && allows(core, TASK_MANOEUVRES)) {
        lap began = mark_time(core);
        count = manoeuvres(core, MANOEUVRES, room->starts + core->at.n);
        learn_time(core, TASK_MANOEUVRES, began, 1);
    }
    return 1 + count;
}

/* Where its search begins: the better of the last plan and the last one that ignored the obstacles.
 * Where an obstacle shaped the last plan, only the sides of the obstacles are sought, and one
 * program about it has to do. */
static const nominal *last_start(scp_core *core, const scp_iterate *last, const scp_iterate *free)
{
    solver_room *room = core->solver;
    const uint8_t *nobody = core->work->nobody;
    nominal *start = &room->start, *other = &room->end.at;
    if (core->linear) {
        nominal_at(core, free != NULL ? free : last, nobody, NULL, start);
        return start;
    }
    nominal_at(core, last, nobody, NULL, start);
    if (core->broken || free == NULL || touches(core, last))
        return start;
    nominal_at(core, free, nobody, NULL, other);
    double merit = merit_of(core, other->cost, 0.0, other->excess);
    return merit < merit_of(core, start->cost, 0.0, start->excess) ? other : start;
}

/* For a linear robot a few linear systems find it. For a nonlinear one the loop does; manoeuvres
 * are tried where there is no last plan, or where it would stand short of its goal. */
static void obstacle_free(scp_core *core, const scp_iterate *last, const scp_iterate *last_free)
{
    solver_room *room = core->solver;
    result *found = &room->free, *end = &room->end;
    int n = core->at.n, touching = last != NULL && touches(core, last), count = 0;
    if (core->linear &&
        obstacle_free_optimum(core, last_free != NULL ? last_free : last, &found->at))
        return;
    const nominal *start = &room->start;
    if (last == NULL) {
        count = starts(core);
        plain_nominal(core, room->starts, NULL, &room->start);
    } else {
        start = last_start(core, last, last_free);
    }
    found->there = 0;
    if (core->broken)
        return;
    if (!touching || room_for(core, TASK_ITERATION, 2, TASK_NONE, 0) == 2)
        run_loop(core, start, NULL, NULL, touching && !core->linear ? 1 : 0, 0, found);
    if (!found->there)
        judge_nominal(core, start, RELAX_NONE, 0, found);
    int first = 1;
    if (last != NULL && stands(core, found->it.states)) {
        count = starts(core);
        first = 0;
    }
    for (int i = first; i < count && !core->broken; i++) {
        if (room_for(core, TASK_ITERATION, SPARE, TASK_NONE, 0) < SPARE)
            break;
        if (plain_nominal(core, room->starts + i * n, NULL, &room->start))
            break;
        run_loop(core, &room->start, found, NULL, 0, 0, end);
        if (end->there && beats(end, found, BETTER * found->merit))
            exchange(found, end);
    }
}

static int is_clear(scp_core *core, const nominal *plan)
{
    const layout *at = &core->at;
    solver_room *room = core->solver;
    size_t mark = core->scratch.used;
    uint8_t *near = bytes(&core->scratch, (size_t)at->most_pairs);
    path_of(core, plan->y, room->path);
    int count = within(core, core->now, room->path, plan->y + at->s, 0.0, NULL, near);
    core->scratch.used = mark;
    return !count;
}

/* ---- risk allocation: Ono and Williams, 2008 */

/* An allocation with the same sum, under which a plan that used so much remains feasible:
 * (1 - k) sum(delta) used / sum(used) + k mean(delta). Nobody is given less than it used. */
static void reallocate(int count, const double *used, double *risks)
{
    double total = 0.0, spent = 0.0, sum = 0.0;
    for (int k = 0; k < count; k++) {
        total += risks[k];
        spent += used[k];
    }
    if (!(spent > 0 && spent < total))
        return;
    double even = fmin(EVEN, (1 - spent / total) / 2);
    for (int k = 0; k < count; k++) {
        risks[k] = (1 - even) * total / spent * used[k] + even * total / count;
        sum += risks[k];
    }
    scale(count, total / sum, risks);
}

/* Improve a plan that keeps a joint risk in equal shares. It stays feasible from one allocation to
 * the next, so that its cost cannot rise. Returns whether another plan came out. */
static int allocate(scp_core *core, result *best)
{
    const layout *at = &core->at;
    solver_room *room = core->solver;
    step *whole = core->now;
    int count = whole->J * at->nodes.size, changed = 0;
    size_t mark = core->scratch.used;
    double *path = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    for (int k = 0; k < count; k++)
        room->risks[k] = core->p.joint_risk / count;
    for (int i = 0; i < ALLOCATIONS; i++) {
        if (!is_ok(best->status) || !touches(core, &best->it) || !allows(core, TASK_ITERATION))
            break;
        nodes_positions(core, at->nodes, best->it.states, best->it.inputs, path);
        step_risks(core, whole, path, room->used);
        reallocate(count, room->used, room->risks);
        for (int k = 0; k < count; k++)
            room->used[k] = size_at_risk(room->risks[k]);
        scale_step(core, whole, room->used, &room->scaled);
        core->now = &room->scaled;
        if (nominal_at(core, &best->it, NULL, NULL, &room->start))
            break;
        run_loop(core, &room->start, NULL, NULL, 0, 0, &room->end);
        if (!room->end.there || !beats(&room->end, best, 0.0))
            break;
        double gain = best->merit - room->end.merit;
        exchange(best, &room->end);
        changed = 1;
        if (gain <= GAIN * best->merit)
            break;
    }
    core->now = whole;
    core->scratch.used = mark;
    return changed;
}

/* ---- fallback */

/* Without a plan that meets every constraint: go on from one that does, if known. What is known is
 * judged by its own motion between the nodes, and so is what it leads to. Returns whether it became
 * another plan. */
static int rescue(scp_core *core, const scp_iterate *last, int brake_first, result *best)
{
    solver_room *room = core->solver;
    result *known = &room->known, *end = &room->end, *better = known;
    int kept = 0;
    if (is_ok(best->status) || !best->has_nominal)
        return 0;
    fall_back(core, &core->plain, last, best, brake_first, known);
    for (int i = 0; i < CORRECTIONS && !kept && is_ok(known->status); i++) {
        if (core->at.nodes.K > 1)
            motion_of(core, &better->it, &room->assumed);
        widen(core, &room->assumed);
        if (nominal_at(core, &better->it, NULL, NULL, &room->start))
            break;
        run_loop(core, &room->start, NULL, NULL, 0, 0, end);
        if (!end->there || !is_ok(end->status))
            break;
        better = end;
        kept = core->at.nodes.K == 1 || is_kept(core, &room->assumed, better);
    }
    exchange(best, kept ? end : known);
    return 1;
}

/* ---- the step */

void write_plan(scp_core *core, const result *best)
{
    scp_outputs *out = &core->out;
    out->status = best->status;
    out->iterations = best->iterations;
    out->cost = best->cost;
    out->merit = best->merit;
    out->stationarity = best->kkt.stationarity;
    out->feasibility = best->kkt.feasibility;
    out->complementarity = best->kkt.complementarity;
    out->curvature = best->kkt.curvature;
    out->u0 = out->plan.inputs;
    copy_iterate(core, &best->it, &out->plan);
}

/* The loop from a start, and what comes after it: alternatives, allocation, fallback. Returns
 * whether the alternatives' multipliers belong to the plan that comes out. */
static int descend(scp_core *core, const scp_iterate *start, const double *about,
                   const scp_iterate *last, int multi, int brake_first, lap *ending)
{
    solver_room *room = core->solver;
    result *best = &room->best;
    int alternatives = 0;
    best->there = 0;
    core->out.candidates = core->out.switched = 0;
    if (core->plain.J && allows(core, TASK_ITERATION) &&
        !nominal_at(core, start, NULL, about, &room->start))
        run_loop(core, &room->start, NULL, about, 0, 0, best);
    *ending = mark_time(core);
    int searched = best->there;
    if (!searched)
        fall_back(core, &core->plain, last, NULL, brake_first, best);
    if (multi_start_wanted(core, best, multi)) {
        multi_start(core, best, room->path + core->at.d, last != NULL);
        alternatives = 1;
        *ending = mark_time(core);
    }
    if (searched && core->p.joint_risk > 0) {
        alternatives &= !allocate(core, best);
        *ending = mark_time(core);
    }
    return !rescue(core, last, brake_first, best) && alternatives;
}

/* What is left where a computation broke down: the last plan, or braking. */
static void break_down(scp_core *core, const scp_iterate *last, int brake_first)
{
    solver_room *room = core->solver;
    core->out.candidates = core->out.switched = core->out.has_obstacle_free = 0;
    core->now = &core->plain;
    forget_alternatives(core);
    fall_back(core, &core->plain, last, NULL, brake_first, &room->best);
    write_plan(core, &room->best);
}

/* Plan from `last`, the plan of the step before, shifted, and the one of then that ignored the
 * obstacles; both may be NULL. */
static void solve_steadily(scp_core *core, const scp_iterate *last, const scp_iterate *last_free,
                           int multi, int brake_first)
{
    solver_room *room = core->solver;
    const layout *at = &core->at;
    result *free = &room->free, *best = &room->best;
    const scp_iterate *start = last != NULL ? last : &core->out.obstacle_free;
    const double *about = last != NULL ? room->about : NULL;
    int between = at->nodes.K > 1 && core->plain.J, i = 0, alternatives = 0;
    lap ending = mark_time(core);
    obstacle_free(core, last, last_free);
    if (core->broken)
        return;
    name_iterate(core, &free->at, INFINITY, &core->out.obstacle_free);
    if (between)
        motion_of(core, &core->out.obstacle_free, &room->free_motion);
    widen(core, &room->free_motion);
    if (is_clear(core, &free->at)) {
        judge_nominal(core, &free->at, RELAX_NONE, 0, free);
        if (is_certified(free->status) || (is_ok(free->status) && !core->plain.J)) {
            write_plan(core, free);
            return;
        }
    }
    core->out.has_obstacle_free = 1;
    /* Where the inputs lead from a state that a disturbance has moved says little about sides. */
    if (last != NULL)
        iterate_outputs(core, last, room->about);
    for (; i < CORRECTIONS && !core->broken; i++, start = &best->it, about = NULL) {
        if (between) {
            motion_of(core, start, &room->own);
            nodes_reserved(at->nodes, &room->own, &room->free_motion, core->p.most_deviation,
                           &room->assumed);
        }
        widen(core, &room->assumed);
        alternatives = descend(core, start, about, last, multi, brake_first, &ending);
        if (!between || is_kept(core, &room->assumed, best))
            break;
    }
    if (i == CORRECTIONS) {
        expose(core, best);
        fall_back(core, &core->plain, last, best, brake_first, &room->known);
        exchange(best, &room->known);
        core->out.has_obstacle_free = best->it.has_multipliers;
        alternatives = 0;
    }
    if (!alternatives)
        forget_alternatives(core);
    write_plan(core, best);
    learn_time(core, TASK_ENDING, ending, 1);
}

void solve_step(scp_core *core, const scp_iterate *last, const scp_iterate *last_free, int multi,
                int brake_first)
{
    begin_transcription(core);
    begin_condensing(core);
    forget_alternatives(core);
    core->out.candidates = core->out.switched = 0;
    core->now = &core->plain;
    solve_steadily(core, last, last_free, multi, brake_first);
    if (core->broken)
        break_down(core, last, brake_first);
}
