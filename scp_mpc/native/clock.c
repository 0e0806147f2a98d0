/* Where the time of one control step goes, and whether what comes next still fits in; deadline.py.
 *
 * Tasks are expected to take as long as the longest of them took lately, slowly forgotten. A single
 * time that is far longer than all before it counts in full if it happens twice in a row. And what
 * is known is tried again: a task that was not begun a few times for its length is begun, and if it
 * is that long still, it is left alone for twice as many times.
 *
 * Without a deadline nothing is measured, but the budget of programs counts.
 */
#include "core.h"

static const double FORGET = 0.02; /* of the difference to a shorter time, each time */
static const double EASE = 0.98;   /* of a time, each time that it stood in the way */
static const double HICCUP = 3.0;  /* times what is known of a task: something else took it */
static const double LEAST = 1e-6;  /* [s] of any task */
static const double RESERVE = 0.1; /* of the deadline, for what takes longer than ever before */

/* Times that a task is not begun before it is tried again, whatever is known. */
enum { PATIENCE = 3, MOST_PATIENCE = 200 };

static int is_counted(task what)
{
    return what == TASK_ITERATION || what == TASK_CANDIDATE; /* solves a program */
}

static int has_deadline(const scp_core *core)
{
    return core->clock.deadline < (double)INFINITY;
}

static double expected(const scp_core *core, task what)
{
    if (what == TASK_NONE || core->clock.pace[what].on_trial)
        return 0;
    return core->clock.pace[what].seconds;
}

/* A task was not begun; `never`, if by what is known no step has room for it. */
static void refuse(scp_core *core, task what, int never)
{
    pace *one = &core->clock.pace[what];
    one->seconds *= EASE;
    one->refused += never;
    if (one->refused >= (one->patience ? one->patience : PATIENCE)) {
        one->refused = 0;
        one->on_trial = 1;
    }
}

static void learn(pace *one, double seconds)
{
    one->measured++;
    if (one->on_trial) {
        int patience = 2 * (one->patience ? one->patience : PATIENCE);
        int still = seconds > one->seconds / 2;
        one->on_trial = 0;
        one->patience = !still ? PATIENCE : patience < MOST_PATIENCE ? patience : MOST_PATIENCE;
        one->seconds = still ? one->seconds : 0;
    }
    double usual = one->seconds > 0 ? HICCUP * one->seconds : (double)INFINITY;
    int twice = one->stalled;
    one->stalled = seconds > usual + LEAST;
    if (one->stalled && !twice)
        seconds = usual;
    double share = fmax(FORGET, 1.0 / one->measured);
    one->seconds = fmax(seconds, one->seconds - share * (one->seconds - seconds));
}

void begin_clock(scp_core *core)
{
    clock_state *clock = &core->clock;
    clock->now = core->p.clock;
    clock->context = core->p.clock_context;
    int timed = clock->now && core->p.deadline > 0;
    clock->deadline = timed ? (1 - RESERVE) * core->p.deadline : (double)INFINITY;
    clock->began = clock->now ? clock->now(clock->context) : 0;
    clock->booked = 0;
    clock->programs = core->p.max_programs;
}

double elapsed(const scp_core *core)
{
    const clock_state *clock = &core->clock;
    return clock->now ? clock->now(clock->context) - clock->began : 0;
}

/* Whether a task, and what ends the step, are predicted to end before the deadline, and whether the
 * budget has room for it. */
int allows(scp_core *core, task what)
{
    clock_state *clock = &core->clock;
    if (is_counted(what) && clock->programs < 1)
        return 0;
    if (has_deadline(core)) {
        double needed = expected(core, what) + expected(core, TASK_ENDING);
        if (needed > clock->deadline - elapsed(core)) {
            refuse(core, what, needed > clock->deadline);
            return 0;
        }
    }
    clock->programs -= is_counted(what);
    return 1;
}

/* How often, up to `most` times, a task fits in before another one; so many programs are spared. */
int room_for(scp_core *core, task what, int most, task then, int spare)
{
    const clock_state *clock = &core->clock;
    if (is_counted(what)) {
        most = clock->programs - spare < most ? clock->programs - spare : most;
        most = most > 0 ? most : 0;
    }
    if (!has_deadline(core))
        return most;
    double after = expected(core, then) + expected(core, TASK_ENDING);
    double left = fmax(clock->deadline - elapsed(core) - after, 0);
    double times = left / fmax(expected(core, what), LEAST);
    if (times >= most)
        return most;
    refuse(core, what, after + expected(core, what) > clock->deadline);
    return (int)times;
}

lap mark_time(const scp_core *core)
{
    return (lap){has_deadline(core) ? elapsed(core) : 0, core->clock.booked};
}

/* A task, done so many times, took from `since` on until now, less the tasks within it. */
void learn_time(scp_core *core, task what, lap since, int times)
{
    if (times <= 0 || !has_deadline(core))
        return;
    double within = core->clock.booked - since.booked;
    double own = elapsed(core) - since.began - within;
    core->clock.booked += own;
    learn(&core->clock.pace[what], own / times);
}
