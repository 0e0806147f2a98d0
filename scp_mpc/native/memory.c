/* What a core remembers of the steps before, as numbers. Another core of the same problem that is given
 * them goes on as this one would, bit for bit: for copies, and for starting again where one stopped.
 */
#include "core.h"

/* NULL stands for zeros, and for nothing to be recalled. */
void memo_doubles(memo *m, size_t n, double *values)
{
    double *there = m->numbers == NULL ? NULL : m->numbers + m->count;
    m->count += n;
    if (there == NULL)
        return;
    if (values == NULL && !m->recalls)
        memset(there, 0, n * sizeof *there);
    else if (values != NULL)
        memcpy(m->recalls ? values : there, m->recalls ? there : values, n * sizeof *values);
}

void memo_ints(memo *m, size_t n, int *values)
{
    for (size_t i = 0; m->numbers != NULL && i < n; i++) {
        if (m->recalls)
            values[i] = (int)m->numbers[m->count + i];
        else
            m->numbers[m->count + i] = values[i];
    }
    m->count += n;
}

static void memo_clock(scp_core *core, memo *m)
{
    for (int k = 0; k < TASKS; k++) {
        pace *one = &core->clock.pace[k];
        memo_doubles(m, 1, &one->seconds);
        memo_ints(m, 1, &one->measured);
        memo_ints(m, 1, &one->refused);
        memo_ints(m, 1, &one->patience);
        memo_ints(m, 1, &one->stalled);
        memo_ints(m, 1, &one->on_trial);
    }
}

static size_t visit(scp_core *core, double *numbers, int recalls)
{
    memo m = {.numbers = numbers, .recalls = recalls};
    memo_controller(core, &m);
    memo_alternatives(core, &m);
    memo_clock(core, &m);
    return m.count;
}

size_t scp_memory_size(scp_core *core) { return visit(core, NULL, 0); }

void scp_remember(scp_core *core, double *numbers) { visit(core, numbers, 0); }

void scp_recall(scp_core *core, double *numbers) { visit(core, numbers, 1); }
