/* What one control step brings, checked before anything is computed; scp_mpc/scp/step.py, and the
 * bounds of layout.py.
 *
 * Notation:
 *     J, M    obstacles of this step, slots for them
 *     C       collision nodes, K n in each interval
 *     E       rows of bounded states and of speed
 */
#include "core.h"
#include "small.h"

static const double LARGEST = 1e15;  /* of any number */
static const double UNIT = 1e-6;     /* by which the length of a normal may differ from one */
static const double TOUCH = 1e-9;    /* [m] within another body that is not */
static const double OUTSIDE = 1e-9;  /* of a bound, in its own unit, that is not */
static const double NONE = 1e30;     /* bounds that are none */
static const double HARD = 10.0;     /* price of a hard state's excess in merits, times that of slack */
static const double TURN = 6.283185307179586;

typedef struct {
    step_room room, scaled;  /* the second is that of the scaled step */
    double *wide_radii;      /* (M, C) */
    double *stds;            /* (M, N+1) largest standard deviations of the predictions */
    double *begin, *along;   /* (max_shapes, max_edges, d) of edges; zeros for corners */
    double *outside, *braked; /* (2, ny) lower and upper bounds */
    int has_braked;
} memory;

/* ---- memory */

void lay_out_step(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    size_t M = (size_t)at->M, N = (size_t)at->N, C = (size_t)at->nodes.size, ny = (size_t)at->ny;
    size_t d = (size_t)at->d, shapes = (size_t)p->max_shapes;
    memory *my = take(from, 1, sizeof *my), none;
    core->steps = my;
    if (!my)
        my = &none;
    lay_out_room(core, from, at->nodes, &my->room);
    if (p->joint_risk > 0)
        lay_out_scaled(core, from, at->nodes, 1, &my->scaled);
    my->wide_radii = doubles(from, M * C);
    my->stds = doubles(from, M * (N + 1));
    my->begin = doubles(from, shapes * (size_t)p->max_edges * d);
    my->along = doubles(from, shapes * (size_t)(p->max_edges + p->max_corners) * d);
    my->outside = doubles(from, at->nb ? 2 * ny : 0);
    my->braked = doubles(from, at->nb ? 2 * ny : 0);
    core->x_ref = doubles(from, (N + 1) * (size_t)at->nx);
    core->solids = take(from, shapes, sizeof(solid));
    core->lower = doubles(from, ny);
    core->upper = doubles(from, ny);
    core->braking_u = doubles(from, N * (size_t)at->nu);
    core->braking_x = doubles(from, (N + 1) * (size_t)at->nx);
    core->row_price = doubles(from, N * (size_t)at->nb);
}

size_t scratch_of_step(const scp_core *core)
{
    const layout *at = &core->at;
    int longest = backup_horizon(core) * at->nodes.count;
    return (size_t)(at->M * longest) + (size_t)(at->nodes.n * at->d) * sizeof(double) + 128;
}

/* ---- checks */

/* A positive double that is larger, infinite or no number has the larger bits: integers are
 * compared, since sums and maxima of doubles in a given order are slow. */
static int are_numbers(int count, const double *x)
{
    const uint64_t unsigned_part = ~(uint64_t)0 >> 1;
    uint64_t most, wrong = 0;
    memcpy(&most, &LARGEST, sizeof most);
    for (int i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, x + i, sizeof bits);
        wrong |= most - (bits & unsigned_part);
    }
    return !(wrong >> 63);
}

static int are_finite_covariances(int d, int count, const double *Sigma, double *stds)
{
    return are_numbers(count * d * d, Sigma) && are_covariances(d, count, Sigma, stds);
}

/* Inputs by number, in the order of their struct. */
enum {
    IN_X0 = 1, IN_X_REF, IN_U_LAST, IN_HAS_U_LAST, IN_COUNT, IN_MEANS, IN_COVARIANCES, IN_RADII,
    IN_SHAPE, IN_SHAPES, IN_CORNERS, IN_FACES, IN_EDGES, IN_CORNER, IN_NORMAL, IN_OFFSET, IN_EDGE,
    IN_ROBOT_COVARIANCE
};

const char *scp_input_name(int number)
{
    static const char *const names[] = {
        "", "x0", "x_ref", "u_last", "has_u_last", "count", "means", "covariances", "radii",
        "shape", "shapes", "corners", "faces", "edges", "corner", "normal", "offset", "edge",
        "robot_covariance"};
    return number > 0 && number <= IN_ROBOT_COVARIANCE ? names[number] : "";
}

static int is_between(int n, int least, int most) { return n >= least && n <= most; }

static int wrong_shape(const scp_core *core, int k)
{
    const scp_problem *p = &core->p;
    const scp_inputs *in = &core->in;
    const int d = p->dim, corners = in->corners[k], faces = in->faces[k];
    const int *edge = in->edge + 2 * k * p->max_edges;
    const double *normal = in->normal + k * p->max_faces * d;
    if (!is_between(corners, d + 1, p->max_corners))
        return IN_CORNERS;
    if (!is_between(faces, d + 1, p->max_faces))
        return IN_FACES;
    if (d == 3 && !is_between(in->edges[k], 6, p->max_edges))
        return IN_EDGES;
    if (!are_numbers(corners * d, in->corner + k * p->max_corners * d))
        return IN_CORNER;
    for (int f = 0; f < faces; f++)
        if (!(fabs(inner(d, normal + f * d, normal + f * d) - 1) <= UNIT))
            return IN_NORMAL;
    if (!are_numbers(faces, in->offset + k * p->max_faces))
        return IN_OFFSET;
    for (int e = 0; d == 3 && e < 2 * in->edges[k]; e++)
        if (!is_between(edge[e], 0, corners - 1))
            return IN_EDGE;
    return 0;
}

static int wrong_obstacle(const scp_core *core, double *stds)
{
    const scp_inputs *in = &core->in;
    const int J = in->count, rows = core->at.N + 1, d = core->at.d;
    if (!is_between(J, 0, core->at.M))
        return IN_COUNT;
    if (!are_numbers(J * rows * d, in->means))
        return IN_MEANS;
    if (!are_finite_covariances(d, J * rows, in->covariances, stds))
        return IN_COVARIANCES;
    for (int j = 0; j < J; j++)
        if (!(in->radii[j] >= 0 && in->radii[j] <= LARGEST))
            return IN_RADII;
    int shapes = 0;
    for (int j = 0; j < J; j++) {
        if (!is_between(in->shape[j], -1, core->p.max_shapes - 1))
            return IN_SHAPE;
        shapes = in->shape[j] >= shapes ? in->shape[j] + 1 : shapes;
    }
    if (!is_between(in->shapes, shapes, core->p.max_shapes))
        return IN_SHAPES;
    for (int k = 0, wrong; k < in->shapes; k++)
        if ((wrong = wrong_shape(core, k)))
            return wrong;
    return 0;
}

static int wrong_input(const scp_core *core, double *stds)
{
    const scp_inputs *in = &core->in;
    const int nx = core->at.nx, rows = core->at.N + 1;
    if (!are_numbers(nx, in->x0))
        return IN_X0;
    if (!are_numbers(rows * nx, in->x_ref))
        return IN_X_REF;
    if (in->has_u_last && !are_numbers(core->at.nu, in->u_last))
        return IN_U_LAST;
    int wrong = wrong_obstacle(core, stds);
    if (wrong)
        return wrong;
    if (in->has_robot_covariance &&
        !are_finite_covariances(core->at.d, rows, in->robot_covariance, NULL))
        return IN_ROBOT_COVARIANCE;
    return 0;
}

/* ---- bounds of y */

void set_up_step(scp_core *core)
{
    const scp_problem *p = &core->p;
    const layout *at = &core->at;
    for (int k = 0; k < at->s; k++) {
        core->lower[k] = -NONE;
        core->upper[k] = NONE;
    }
    for (int j = 0; j < at->M; j++) {
        core->lower[at->s + j] = p->s_min;
        core->upper[at->s + j] = p->s_max;
    }
    for (int k = 0; k < at->n; k++) {
        core->lower[at->u + k] = p->u_min[k % at->nu];
        core->upper[at->u + k] = p->u_max[k % at->nu];
    }
    for (int k = 0; k < at->rated; k++) {
        core->lower[at->du + k] = larger(p->du_min[k % at->nu], -NONE);
        core->upper[at->du + k] = lesser(p->du_max[k % at->nu], NONE);
    }
    for (int k = 0; k < at->N * at->nb; k++)
        core->row_price[k] = p->row_soft[k % at->nb] ? p->state_slack_weight : HARD * p->slack_weight;
}

static double row_of(const scp_core *core, int r, const double *x)
{
    return dot(core->at.nx, core->p.row + r * core->at.nx, x);
}

/* Bounds (2, ny) in which rows that are hard go as far as full braking does: all, or those that are
 * outside their bounds now. Returns whether there are any. */
static int go_as_far_as_braking(scp_core *core, int all, double *to)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    double *lower = to + at->z, *upper = to + at->ny + at->z;
    int any = 0;
    for (int r = 0; r < at->nb; r++) {
        double here = row_of(core, r, core->plain.x0);
        int low = all || here < p->row_min[r] - OUTSIDE, high = all || here > p->row_max[r] + OUTSIDE;
        if (p->row_soft[r] || !(low || high))
            continue;
        if (!any) {
            memcpy(to, core->lower, (size_t)at->ny * sizeof *to);
            memcpy(to + at->ny, core->upper, (size_t)at->ny * sizeof *to);
            brake_now(core);
            any = 1;
        }
        for (int i = 0; i < at->N; i++) {
            int stage = i + 1 < core->braking_steps ? i + 1 : core->braking_steps;
            double after = row_of(core, r, core->braking_x + stage * at->nx);
            double reference = row_of(core, r, core->x_ref + (i + 1) * at->nx);
            if (low)
                lower[i * at->nb + r] = larger(lesser(after, p->row_min[r]) - reference, -NONE);
            if (high)
                upper[i * at->nb + r] = lesser(larger(after, p->row_max[r]) - reference, NONE);
        }
    }
    return any;
}

static void read_bounds(scp_core *core)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    memory *my = core->steps;
    if (at->rated) {
        double *lower = core->lower + at->du, *upper = core->upper + at->du;
        const double *last = core->plain.u_last;
        reach(core, last, lower, upper);
        for (int l = 0; l < at->nu; l++) {
            lower[l] = larger(lower[l] - (last ? last[l] : 0), -NONE);
            upper[l] = lesser(upper[l] - (last ? last[l] : 0), NONE);
        }
    }
    for (int i = 0; i < at->N; i++)
        for (int r = 0; r < at->nb; r++) {
            double reference = row_of(core, r, core->x_ref + (i + 1) * at->nx);
            core->lower[at->z + i * at->nb + r] = larger(p->row_min[r] - reference, -NONE);
            core->upper[at->z + i * at->nb + r] = lesser(p->row_max[r] - reference, NONE);
        }
    int outside = go_as_far_as_braking(core, 0, my->outside);
    core->strict_lower = outside ? my->outside : core->lower;
    core->strict_upper = outside ? my->outside + at->ny : core->upper;
    core->braked_lower = core->lower;
    core->braked_upper = core->upper;
    my->has_braked = 0;
}

void brake_bounds(scp_core *core)
{
    memory *my = core->steps;
    if (!my->has_braked && go_as_far_as_braking(core, 1, my->braked)) {
        core->braked_lower = my->braked;
        core->braked_upper = my->braked + core->at.ny;
    }
    my->has_braked = 1;
}

/* ---- state, reference and shapes */

/* Headings are angles: unwrapped, row by row, from that of the state, so that the plan never turns
 * the long way round. */
static void read_reference(scp_core *core)
{
    const int nx = core->at.nx, rows = core->at.N + 1, heading = core->p.heading;
    memcpy(core->x_ref, core->in.x_ref, (size_t)(rows * nx) * sizeof(double));
    if (heading < 0)
        return;
    double before = core->in.x0[heading], turns = 0;
    for (int i = 0; i < rows; i++) {
        double *angle = core->x_ref + i * nx + heading, given = *angle;
        turns += rint((given - before) / TURN);
        *angle = given - TURN * turns;
        before = given;
    }
}

static void read_shapes(scp_core *core)
{
    const scp_problem *p = &core->p;
    const scp_inputs *in = &core->in;
    const memory *my = core->steps;
    const int d = p->dim;
    for (int k = 0; k < in->shapes; k++) {
        const double *corner = in->corner + k * p->max_corners * d;
        const int *edge = in->edge + 2 * k * p->max_edges, edges = d == 3 ? in->edges[k] : 0;
        double *begin = my->begin + k * p->max_edges * d;
        double *along = my->along + k * (p->max_edges + p->max_corners) * d, most = 0;
        for (int e = 0; e < edges; e++) {
            memcpy(begin + e * d, corner + edge[2 * e] * d, (size_t)d * sizeof *begin);
            difference(d, corner + edge[2 * e + 1] * d, begin + e * d, along + e * d);
        }
        for (int v = 0; v < in->corners[k]; v++)
            most = larger(inner(d, corner + v * d, corner + v * d), most);
        core->solids[k] = (solid){
            .corners = in->corners[k], .faces = in->faces[k],
            .ridges = d == 3 ? edges : in->corners[k], .corner = corner,
            .normal = in->normal + k * p->max_faces * d, .offset = in->offset + k * p->max_faces,
            .begin = d == 3 ? begin : corner, .along = along, .size = sqrt(most)};
    }
}

/* Whether the robot touches an obstacle now, if they are where they are expected to be. */
static int is_touching(scp_core *core)
{
    const step *at = &core->plain;
    const int d = core->at.d, n = at->nodes.n;
    size_t mark = core->scratch.used;
    double *here = doubles(&core->scratch, (size_t)(n * d));
    int touching = 0;
    nodes_now(core, at->x0, here);
    for (int j = 0; j < at->J; j++)
        for (int k = 0; k < n; k++) {
            double y[3];
            difference(d, here + k * d, at->means + j * (at->nodes.size + 1) * d, y);
            double gap = at->shape[j] < 0 ? sqrt(inner(d, y, y))
                                          : solid_distance(d, core->solids + at->shape[j], y, NULL,
                                                           NULL, NULL);
            touching |= gap < core->p.robot_radius + core->given.radii[j] - TOUCH;
        }
    core->scratch.used = mark;
    return touching;
}

int read_step(scp_core *core)
{
    memory *my = core->steps;
    const scp_inputs *in = &core->in;
    int wrong = wrong_input(core, my->stds);
    if (wrong)
        return wrong;
    read_reference(core);
    read_shapes(core);
    core->given = (predictions){in->count, in->means, in->covariances, my->stds, in->radii, in->shape};
    double scale = core->p.sizes ? core->p.sizes[in->count] / core->p.s_ref : 1;
    predict(core, &core->given, in->has_robot_covariance ? in->robot_covariance : NULL, scale,
            &my->room, &core->plain);
    core->plain.x0 = in->x0;
    core->plain.x_ref = core->x_ref;
    core->plain.u_last = in->has_u_last ? in->u_last : NULL;
    core->wide = core->plain;
    core->wide.radii = my->wide_radii;
    core->now = &core->plain;
    core->braking_steps = -1;
    read_bounds(core);
    core->out.contact = is_touching(core);
    return 0;
}

void scale_step(scp_core *core, const step *from, const double *sizes, step *to)
{
    step_room *room = &((memory *)core->steps)->scaled;
    step scaled = *from;
    scale_covariances(core->at.d, sizes, 1 / core->p.s_ref, from->nodes, room, &scaled);
    scaled.rotation = room->rotation;
    scaled.deviation = room->deviation;
    scaled.decomposed = room->decomposed;
    memset(room->decomposed, 0, (size_t)(from->J * from->nodes.size));
    *to = scaled;
}
