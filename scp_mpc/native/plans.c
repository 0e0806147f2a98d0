/* Memory of plans, in all the forms that the core has of one, and copies of them. */
#include "core.h"

void lay_out_derivatives(const scp_core *core, arena *from, derivatives *D)
{
    size_t N = (size_t)core->at.N, nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    size_t part = (size_t)(core->at.nodes.n * core->at.d);
    size_t m = (size_t)(core->at.nodes.K - 1) * part;
    D->A = doubles(from, N * nx * nx);
    D->B = doubles(from, N * nx * nu);
    D->C = doubles(from, N * m * nx);
    D->D = doubles(from, N * m * nu);
    D->at = doubles(from, N * part * nx);
}

void lay_out_nominal(const scp_core *core, arena *from, nominal *n)
{
    const layout *at = &core->at;
    size_t states = (size_t)(at->N * at->nx), d = (size_t)at->d, most = (size_t)at->most_pairs;
    n->y = n->planes.y = doubles(from, (size_t)at->ny);
    n->roll.u = doubles(from, (size_t)at->n);
    n->roll.e = doubles(from, states);
    n->roll.p = doubles(from, (size_t)at->nodes.size * d);
    if (core->linear)
        n->roll.along = core->always;
    else
        lay_out_derivatives(core, from, &n->roll.along);
    n->costates = doubles(from, states);
    n->reaction = doubles(from, (size_t)at->nf);
    n->pairs.obstacle = ints(from, most);
    n->pairs.node = ints(from, most);
    n->pairs.near = bytes(from, most);
    n->planes.g = doubles(from, most);
    n->planes.a = doubles(from, most * (d + 1));
    n->planes.bend = doubles(from, most * d * (d - 1));
    n->force = doubles(from, most);
    n->slack = doubles(from, most);
    n->excess = doubles(from, (size_t)(at->N * at->nb));
}

void lay_out_iterate(const scp_core *core, arena *from, scp_iterate *it)
{
    const layout *at = &core->at;
    size_t nx = (size_t)at->nx, n = (size_t)at->n, M = (size_t)at->M;
    it->states = doubles(from, (size_t)(at->N + 1) * nx);
    it->inputs = doubles(from, n);
    it->s = doubles(from, M);
    it->slack = doubles(from, (size_t)at->most_pairs);
    it->dynamics = doubles(from, (size_t)at->N * nx);
    it->input_bounds = doubles(from, n);
    it->margin = doubles(from, M);
    it->obstacles = doubles(from, (size_t)at->most_pairs);
    it->pins = doubles(from, (size_t)at->most_pairs);
    it->state_bounds = doubles(from, (size_t)(at->N * at->nb));
    it->rates = doubles(from, n);
}

void lay_out_result(const scp_core *core, arena *from, result *r)
{
    lay_out_iterate(core, from, &r->it);
    lay_out_nominal(core, from, &r->at);
}

/* ---- copies; onto itself is allowed */

void copy_doubles(int count, const double *from, double *to)
{
    if (from != to)
        memcpy(to, from, (size_t)count * sizeof(double));
}

static void copy_derivatives(const scp_core *core, const derivatives *from, derivatives *to)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    int part = core->at.nodes.n * core->at.d, m = (core->at.nodes.K - 1) * part;
    copy_doubles(N * nx * nx, from->A, to->A);
    copy_doubles(N * nx * nu, from->B, to->B);
    copy_doubles(N * m * nx, from->C, to->C);
    copy_doubles(N * m * nu, from->D, to->D);
    copy_doubles(N * part * nx, from->at, to->at);
}

void copy_nominal(const scp_core *core, const nominal *from, nominal *to)
{
    const layout *at = &core->at;
    int count = from->pairs.count, d = at->d;
    if (from == to)
        return;
    copy_doubles(at->ny, from->y, to->y);
    copy_doubles(at->n, from->roll.u, to->roll.u);
    copy_doubles(at->N * at->nx, from->roll.e, to->roll.e);
    copy_doubles(at->nodes.size * d, from->roll.p, to->roll.p);
    if (core->linear)
        to->roll.along = from->roll.along;
    else
        copy_derivatives(core, &from->roll.along, &to->roll.along);
    copy_doubles(at->N * at->nx, from->costates, to->costates);
    copy_doubles(at->nf, from->reaction, to->reaction);
    to->pairs.count = count;
    memcpy(to->pairs.obstacle, from->pairs.obstacle, (size_t)count * sizeof(int));
    memcpy(to->pairs.node, from->pairs.node, (size_t)count * sizeof(int));
    memcpy(to->pairs.near, from->pairs.near, (size_t)at->most_pairs);
    copy_doubles(count, from->planes.g, to->planes.g);
    copy_doubles(count * (d + 1), from->planes.a, to->planes.a);
    copy_doubles(count * d * (d - 1), from->planes.bend, to->planes.bend);
    copy_doubles(count, from->force, to->force);
    copy_doubles(count, from->slack, to->slack);
    copy_doubles(at->N * at->nb, from->excess, to->excess);
    to->cost = from->cost;
    to->kkt = from->kkt;
}

void copy_iterate(const scp_core *core, const scp_iterate *from, scp_iterate *to)
{
    const layout *at = &core->at;
    copy_doubles((at->N + 1) * at->nx, from->states, to->states);
    copy_doubles(at->n, from->inputs, to->inputs);
    copy_doubles(at->M, from->s, to->s);
    copy_doubles(at->most_pairs, from->slack, to->slack);
    to->has_multipliers = from->has_multipliers;
    if (!from->has_multipliers)
        return;
    copy_doubles(at->N * at->nx, from->dynamics, to->dynamics);
    copy_doubles(at->n, from->input_bounds, to->input_bounds);
    copy_doubles(at->M, from->margin, to->margin);
    copy_doubles(at->most_pairs, from->obstacles, to->obstacles);
    copy_doubles(at->most_pairs, from->pins, to->pins);
    copy_doubles(at->N * at->nb, from->state_bounds, to->state_bounds);
    copy_doubles(at->rated, from->rates, to->rates);
}

void copy_result(const scp_core *core, const result *from, result *to)
{
    if (from == to)
        return;
    copy_iterate(core, &from->it, &to->it);
    to->cost = from->cost;
    to->merit = from->merit;
    to->kkt = from->kkt;
    to->status = from->status;
    to->iterations = from->iterations;
    to->there = from->there;
    to->has_nominal = from->has_nominal;
    if (from->has_nominal)
        copy_nominal(core, &from->at, &to->at);
}

