/* What the parts of the core share. Names and notation are those of the Python loop: each part has
 * its counterpart there, and says which.
 *
 *     y       [p_1 .. p_C | s_1 .. s_M | u_0 .. u_{N-1} | du_0 .. | z_1 .. z_N]     scp/layout.py
 *     v       (nv,) inputs and sizes that move, in coordinates that make the Hessian the identity
 *     boxed   the entries of y that are bounded and can move: from `boxed` to the end, nf of them
 *     pair    k = 0 .. count-1 of obstacle and node
 *     g, a    constraint function of a pair, to be non-negative, and its gradient (d+1,)
 *
 * Memory: lay_out_*() takes it from an arena, twice: once to measure, once in earnest; it must not
 * look into it. set_up_*() then computes what stays. Steps allocate nothing. What a function needs
 * for itself only it takes from `core->scratch` and gives back before it returns.
 */
#ifndef SCP_CORE_H
#define SCP_CORE_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "scp_mpc.h"

/* ---- memory */

typedef struct {
    char *base; /* NULL: only measures */
    size_t used, size, most;
} arena;

void *take(arena *from, size_t count, size_t size); /* 64-byte aligned; NULL while measuring */
double *doubles(arena *from, size_t count);
int *ints(arena *from, size_t count);
uint8_t *bytes(arena *from, size_t count);

/* ---- sizes */

/* Collision nodes of a horizon. In an interval: instant after instant, at each disc after disc. */
typedef struct {
    int N, K, n;
    int count; /* K n, in an interval */
    int size;  /* C = N K n */
} nodes;

typedef struct {
    int N, nx, nu, d, M, nb;
    nodes nodes;
    int moving;                  /* sizes that can move: M or 0 */
    int n;                       /* N nu */
    int nv, ny, nf;
    int p, s, u, du, z, boxed;   /* where they begin in y */
    int inputs, rates, states;   /* likewise among the boxed */
    int rated;                   /* N nu if rates are limited, else 0 */
    int most_pairs;              /* M C */
} layout;

/* ---- plans */

/* Derivatives of the dynamics about a plan; condensing.py. */
typedef struct {
    double *A, *B;   /* (N, nx, nx), (N, nx, nu); A[0] is never asked for */
    double *C, *D;   /* (N, m, nx), (N, m, nu) of positions between samples, m = (K-1) n d; unused if K = 1 */
    double *at;      /* (N, n d, nx) of positions at samples */
} derivatives;

/* A plan that obeys the dynamics. */
typedef struct {
    double *u;       /* (N, nu) */
    double *e;       /* (N, nx) deviations x_i - xref_i, i = 1 .. N */
    double *p;       /* (C, d) positions relative to where the robot is now */
    derivatives along; /* of a linear robot: shared by all */
} rollout;

/* Which pairs of obstacle and node are looked at; pairs.py. */
typedef struct {
    int count;
    int *obstacle, *node; /* (count,), in the order of numpy.nonzero(near) */
    uint8_t *near;        /* (M, C) */
} pairs;

/* Half-spaces g + a'(y[at] - y0[at]) >= 0 of pairs, linearised about y0. */
typedef struct {
    double *y;        /* (ny,) y0 */
    double *g;        /* (count,) */
    double *a;        /* (count, d+1) on position and size */
    double *bend;     /* (count, d, d-1) factors of the second derivative of polytopes in p */
} planes;

typedef struct {
    double stationarity, feasibility, complementarity, curvature; /* curvature NaN: unknown */
} residuals;

double worst_of(const residuals *r); /* of the first three; NaN counts as infinite */

/* A plan with multipliers and residuals: the loop's iterate; certificate.py. */
typedef struct {
    double *y;         /* (ny,) */
    rollout roll;
    double *costates;  /* (N, nx) */
    double *reaction;  /* (nf,) forces of the bounds, positive at lower ones */
    pairs pairs;
    planes planes;     /* planes.y is this y */
    double *force;     /* (count,) */
    double *slack;     /* (count,) */
    double *excess;    /* (N nb,) */
    double cost;
    residuals kkt;
} nominal;

/* Who is relaxed where constraints cannot all be met; transcription.py. */
typedef enum { RELAX_NONE, RELAX_STATES, RELAX_ALL } relaxation;

/* Where one run of the loop ended, or a plan that needs no program; plan.py. */
typedef struct {
    scp_iterate it;
    double cost, merit;
    residuals kkt;
    scp_status status;
    int iterations;
    int there;        /* whether this is a result at all */
    int has_nominal;
    nominal at;       /* the same point as the loop knows it */
} result;

int is_ok(scp_status status);
int is_certified(scp_status status); /* CONVERGED or SOFTENED */

/* ---- the step: step.py */

typedef struct {
    int J;
    nodes nodes;
    const double *x0, *x_ref;      /* (nx,), (N+1, nx) with headings unwrapped */
    const double *u_last;          /* (nu,) or NULL */
    const double *means;           /* (J, C+1, d) at nodes, row 0 now */
    const double *covariances;     /* (J, C+1, d, d) grown, with the robot's, scaled */
    const double *largest_std;     /* (J, C+1) bounds of deviations in any direction */
    const double *drift;           /* (J, C) way of the obstacles between two instants; NULL if K = 1 */
    const double *bare, *bare_std; /* covariances and largest_std before sizes scaled them */
    double *radii;                 /* (J, C), widened or plain */
    double *rotation, *deviation;  /* (J, C, d, d) and (J, C, d): eigenvectors in columns, ascending */
    uint8_t *decomposed;           /* (J, C) which of these are there: see no_go_of */
    const int *shape;              /* (J,) polytope of an obstacle, -1 for a ball */
    int has_shapes;                /* whether any is one */
} step;

/* Predictions of J obstacles, row 0 now. */
typedef struct {
    int J;
    const double *means, *covariances, *largest_std; /* (J, N+1, ...) */
    const double *radii;                             /* (J,) */
    const int *shape;                                /* (J,) */
} predictions;

/* Memory for the arrays of a step. */
typedef struct {
    nodes nodes;
    double *means, *covariances, *scaled, *largest_std, *scaled_std, *drift, *radii;
    double *rotation, *deviation;
    uint8_t *decomposed;
} step_room;

/* ---- polytopes of a step; polytopes.py */

typedef struct {
    int corners, faces, ridges;
    const double *corner, *normal, *offset; /* (corners, d), (faces, d), (faces,) */
    const double *begin, *along;            /* (ridges, d): corners in the plane, edges in space */
    double size;                            /* how far its corners are from the origin */
} solid;

/* One no-go set: the s-sigma ellipsoid and the radii, or a polytope. */
typedef struct {
    const double *mean, *rotation, *deviation; /* (d,), (d, d), (d,) */
    double radius;
    const solid *body; /* NULL: an ellipsoid */
} no_go;

/* ---- programs: active_set.py */

/* Coordinates in which another Hessian is the identity: v = origin + back w, where back is L^-T or
 * I + V'diag(stretch) V. */
typedef struct {
    const double *origin;         /* (nv,) */
    const double *L;              /* (nv, nv) lower Cholesky factor of the Hessian, or NULL */
    const double *V, *stretch;    /* (q, nv), (q,) */
    int q;
} metric;

/* minimise |w|^2 / 2 subject to lower <= F v <= upper, A v >= b, where v = w, or where there is
 * another metric, as that says. Rows are made when they are asked for. */
typedef struct {
    int nv, nf, pairs, d, n;
    const double *F;              /* (nf, nv): S from `boxed` on */
    const double *lower, *upper;  /* (nf,) of F v; beyond 1e29 none */
    const double *a;              /* (pairs, d+1) */
    const double *S;              /* (ny, nv) responses of all outputs */
    const int *at;                /* (pairs, 2) rows of S: first of position, that of size; -1: none */
    const double *b;              /* (pairs,) */
    const double *l1_weight;      /* (nf + pairs,) largest forces, infinite where none yields; NULL: none may */
    double least;                 /* cost at v = 0 */
    const metric *metric;         /* NULL: v = w */
} qp;

/* The solution of a program. In `force`, `active` and `relaxed` bounds come first, then pairs. */
typedef struct {
    double *v;          /* (nv,) in the program's own coordinates before the metric: v, not w */
    double *force;      /* (nf + pairs,) positive at lower bounds and half-spaces */
    int8_t *active;     /* (nf + pairs,) -1 at a lower bound or half-space, 1 at an upper bound */
    uint8_t *relaxed;   /* (nf + pairs,) constraints that yield at the largest force */
    int count;          /* active constraints that hold with equality */
    int *index;         /* (count,) which they are, ascending */
    double *rows;       /* (count, nv) their responses to v */
    double *factor;     /* (count, count) lower Cholesky factor of rows rows', row by row; upper part zero */
} solution;

typedef enum { QP_SOLVED, QP_INFEASIBLE, QP_UNSOLVED, QP_CUT } qp_end;

/* ---- condensing: condensing.py */

/* How outputs answer to v along some derivatives. A Riccati pass gives the coordinates,
 *     cost = least + |v|^2 / 2,     u = u_free + T_i' v_i - K_i (e - e_free),
 * so that v_i acts on interval i and later ones only: rows of S are zero beyond their interval. Any
 * rotation of v would do; Python's is another. u = u_free + (rows u of S) v; sizes come last in v. */
typedef struct {
    double *K;        /* (N, nu, nx) feedback of the plan that nothing constrains */
    double *T;        /* (N, nu, nu) inverses of lower Cholesky factors of 2 R + B'P B */
    double *A;        /* (N, nx, nx) closed loop A - B K */
    double *E;        /* (N, nx, n) responses of e to v */
    double *S;        /* (ny, nv) */
} sensitivity;

typedef struct {
    const rollout *about;
    double *y_free;   /* (ny,) */
    double *here;     /* (nv,) where the plan itself is */
    double least;
    const sensitivity *by;
} condensed;

/* A convex subproblem about a plan. */
typedef struct {
    condensed c;
    const nominal *about;   /* whose pairs it holds */
    planes planes;          /* which need not be those of `about` */
    relaxation level;
    qp qp;
    double *lower, *upper, *b, *l1_weight; /* storage of qp's */
    int *at;
    double *W;              /* (nv, nv) what the program leaves out, where its convex solution is; */
    int bent;               /* whether it is there: newton.c's curvature() */
} program;

typedef enum { PROGRAM_SOLVED, PROGRAM_UNSOLVED, PROGRAM_LATE } program_end;

/* What all runs of the loop work with, one after the other. */
typedef struct {
    program program;
    sensitivity by;         /* of a nonlinear robot */
    solution convex;
    uint8_t *nobody;        /* (M, C) no pair at all */
    double *full;           /* (M,) sizes as they are wanted */
} workspace;

/* ---- time: deadline.py */

typedef enum {
    TASK_ITERATION, TASK_CANDIDATE, TASK_REPAIR, TASK_LONGER_RUN, TASK_RESCUE, TASK_ENDING,
    TASK_BACKUP, TASK_MANOEUVRES, TASKS, TASK_NONE = TASKS
} task;

typedef struct {
    double seconds;
    int measured, refused, patience;
    int stalled, on_trial;
} pace;

typedef struct {
    double deadline;            /* infinite: none */
    double (*now)(void *context);
    void *context;
    double began, booked;
    int programs;               /* how many may still be solved or ranked */
    pace pace[TASKS];
} clock_state;

/* Motion of a robot between two neighbouring instants, interval by interval; nodes.py. */
typedef struct {
    double *chord, *deviation; /* (N,) */
} motion;

/* ---- the core */

struct scp_core {
    scp_problem p;             /* its arrays are copies in the block */
    layout at;
    int linear;
    arena scratch;             /* of the block: `scratch.used` is put back by who takes */
    scp_inputs in;
    scp_outputs out;
    scp_iterate guess, guess_free;   /* where to start; the obstacle-free plan of the step before */
    int has_guess, has_guess_free;
    clock_state clock;

    /* the step */
    step plain, wide;          /* radii as given; with room for what happens between nodes */
    step *now;                 /* the one that counts just now */
    double *x_ref;             /* (N+1, nx) unwrapped */
    predictions given;         /* as they came */
    solid *solids;             /* (max_shapes,) */
    double *lower, *upper;     /* (ny,) bounds of y */
    double *strict_lower, *strict_upper; /* those outside their bounds now as far as braking goes */
    double *braked_lower, *braked_upper; /* all hard ones so; see brake_bounds */
    double *braking_u, *braking_x; /* (N, nu), (N+1, nx) braking from now on; see brake_now */
    int braking_steps;             /* -1: not computed yet */
    double *row_price;         /* (N nb,) price of a state's excess in merits */

    /* of a linear robot: always the same */
    derivatives always;
    sensitivity always_by;
    double *drift;             /* (N, nx) condensing.py's _drift */
    int *reach;                /* (ny,) inputs that come before an output: a row of S is zero from
                                * there to n, where the sizes begin */

    int broken;                /* whether a computation broke down in this step */
    workspace *work;

    void *models, *geometry, *condensing, *active, *certify, *loop, *newton, *multi,
        *fallback, *backup, *solver, *memory, *steps; /* what the parts keep for themselves */
};

/* ---- linear algebra: linalg.c. Matrices row by row; lda = columns unless said. */

double dot(int n, const double *a, const double *b);
void axpy(int n, double alpha, const double *x, double *y);            /* y += alpha x */
void scale(int n, double alpha, double *x);
double norm2(int n, const double *a);                                   /* Euclidean length */
double largest_abs(int n, const double *a);                             /* NaN if any is */
void gemv(int m, int n, const double *A, const double *x, double *y);   /* y = A x */
void gemv_t(int m, int n, const double *A, const double *x, double *y); /* y = A'x */
void gemm(int m, int k, int n, const double *A, const double *B, double *C);    /* C = A B, A (m,k) */
void gemm_tn(int k, int m, int n, const double *A, const double *B, double *C); /* C = A'B, A (k,m) */
void gemm_nt(int m, int k, int n, const double *A, const double *B, double *C); /* C = A B', B (n,k) */
int cholesky(int n, double *A);                      /* lower, in place, upper part zeroed; 0 if positive definite */
void solve_lower(int n, const double *L, double *x);   /* x <- L^-1 x */
void solve_lower_t(int n, const double *L, double *x); /* x <- L^-T x */
void invert_lower(int n, const double *L, double *inverse);
void eigen_small(int d, const double *A, double *values, double *vectors); /* d = 2, 3: ascending, in columns */
/* Symmetric (n, n), destroyed: all eigenvalues ascending, eigenvectors in COLUMNS of vectors. */
int eigen(int n, double *A, double *values, double *vectors, arena *scratch);
/* Smallest eigenvalue of a symmetric (n, n) that is destroyed, and its vector; largest modulus, too. */
int eigen_least(int n, double *A, double *least, double *most_abs, double *vector, arena *scratch);
size_t scratch_of_linalg(const scp_core *core);

/* ---- robots: robots.c; models/ */

int model_step(const scp_core *core, const double *x, const double *u, double *after); /* 0, or nothing */
int model_advance(const scp_core *core, int count, const double *x, const double *u, double share,
                  double *after);
int model_linearise(const scp_core *core, int count, const double *x, const double *u, double share,
                    double *after, double *A, double *B);
int model_curvature(const scp_core *core, int count, const double *x, const double *u,
                    const double *costates, double share, double *bent);
void model_stopping_input(const scp_core *core, const double *x, double *u);

/* ---- nodes.c; scp/nodes.py */

nodes nodes_of(int N, int K, int n);
void nodes_now(const scp_core *core, const double *x0, double *p);                  /* (n, d) */
void nodes_positions(const scp_core *core, nodes of, const double *X, const double *U, double *p);
/* p (C, d) absolute, and D.C, D.D, D.at */
int nodes_derivatives(const scp_core *core, nodes of, const double *X, const double *U, double *p,
                      derivatives *D);
void nodes_motion(const scp_core *core, nodes of, const double *X, const double *U, motion *m);
void nodes_reserved(nodes of, const motion *a, const motion *b, double least, motion *m);
int nodes_cover(nodes of, const motion *assumed, const motion *own);
void nodes_radii(nodes of, int J, const double *radii, const double *drift, const motion *m,
                 double *wide); /* (J, C) each */
/* stages (N, nx+nu, nx+nu), sway (N,) or untouched; returns whether there is a sway */
int nodes_curvature(const scp_core *core, const double *X, const double *U, const double *nu,
                    const double *phi, double *stages, double *sway);
size_t scratch_of_nodes(const scp_core *core);

/* ---- geometry.c, polytopes.c; geometry/ */

void no_go_of(const scp_core *core, const step *at, int j, int node, no_go *set); /* decomposes once */
/* g, a (d+1,) and for polytopes bend (d, d-1) at a position and a size. `before`: the offset from
 * the obstacle one node earlier, which decides where the nearest side is not unique. */
double linearise_no_go(const scp_core *core, const no_go *set, const double *position, double s,
                       const double *before, double *a, double *bend);
/* Factor L (d+1, d-1) of g's second derivative in (p, s), where g was linearised. */
void no_go_curvature(const scp_core *core, const no_go *set, double s, double g, const double *a,
                     const double *bend, double *L);
double signed_distance(int d, const double *y, const double *semi_axes, const double *side, double *n);
double solid_distance(int d, const solid *body, const double *y, const double *side, double *n,
                      double *bend); /* n, bend may be NULL */
void solid_over(int d, const solid *body, int face, const double *y, double *to);
void tangents(int d, const double *n, double *T); /* T (d, d-1) completes a unit vector to a basis */
double risk_of(const scp_core *core, const no_go *set, const double *position); /* risk_bound */
double size_at_risk(double risk);

/* ---- step.c; step.py, layout.py's bounds */

void lay_out_step(scp_core *core, arena *from);
void set_up_step(scp_core *core);
size_t scratch_of_step(const scp_core *core);
/* Checks core->in; 0, or the number of the input that is wrong. Then core->now is `plain`; `wide` has
 * radii of its own, which are not filled yet; bounds that are the same are one array. */
int read_step(scp_core *core);
void brake_bounds(scp_core *core); /* core->braked_*, once a step */
/* Step.scaled with sizes (J, C); there is one scaled step */
void scale_step(scp_core *core, const step *from, const double *sizes, step *to);

/* ---- predictions.c; step.py */

void lay_out_room(const scp_core *core, arena *from, nodes of, step_room *room);
void lay_out_scaled(const scp_core *core, arena *from, nodes of, int scales, step_room *room);
double largest_variance(int d, const double *Sigma);
/* whether all are symmetric and positive semi-definite; stds (count,) may be NULL */
int are_covariances(int d, int count, const double *Sigma, double *stds);
void predict(const scp_core *core, const predictions *given, const double *robot_covariance,
             double scale, step_room *room, step *to); /* all of a step but x0, x_ref and u_last */
void scale_covariances(int d, const double *sizes, double scale, nodes of, step_room *room, step *to);
/* node i counts from 0 = now: `path` is (C+1, d) */
int within(const scp_core *core, const step *at, const double *path, const double *s,
           double distance, const uint8_t *known, uint8_t *near); /* how many; near (J, C) */
void depths(scp_core *core, const step *at, const double *path, const double *s,
            double *deep); /* (J, C); path (C, d) of nodes 1 .. C; s (M,) */
void path_of(const scp_core *core, const double *y, double *path); /* (C+1, d), absolute */
void step_risks(const scp_core *core, const step *at, const double *path, double *risks); /* (J, C) */

/* ---- braking.c; braking.py, problem.py */

static const double AT_REST = 0.05; /* [m/s] at which a robot counts as standing */

int braking(const scp_core *core, int N, const double *x, const double *u_last, double *U,
            double *X); /* steps; U (N, nu), X (N+1, nx) */
void brake_now(scp_core *core); /* core->braking_*, once a step */
void resting_input(const scp_core *core, double *u);
/* What rates allow of the first input after u_last (nu,): infinite where they are not bounded, or
 * where u_last is NULL, unknown. */
void reach(const scp_core *core, const double *u_last, double *lower, double *upper);
void limited(const scp_core *core, int N, double *U, const double *u_last); /* in place */
int stands(const scp_core *core, const double *X);
double row_excess(const scp_core *core, int N, const double *X, int hard_only); /* most, states 1 .. N */
double plan_cost(const scp_core *core, const double *X, const double *U, const double *s);
double plan_penalty(const scp_core *core, const double *slack, const double *X); /* slack (M, C) */

/* ---- plans.c */

void copy_doubles(int count, const double *from, double *to); /* onto itself is allowed */
void lay_out_derivatives(const scp_core *core, arena *from, derivatives *D);
void lay_out_nominal(const scp_core *core, arena *from, nominal *n);
void copy_nominal(const scp_core *core, const nominal *from, nominal *to);
void lay_out_result(const scp_core *core, arena *from, result *r);
void copy_result(const scp_core *core, const result *from, result *to);
void lay_out_iterate(const scp_core *core, arena *from, scp_iterate *it);
void copy_iterate(const scp_core *core, const scp_iterate *from, scp_iterate *to);

/* ---- riccati.c; condensing.py */

void add_product(int m, int n, const double *A, const double *x, double *y);   /* y += A x, A (m, n) */
void add_product_t(int m, int n, const double *A, const double *x, double *y); /* y += A'x */
void derivatives_roll(const scp_core *core, const derivatives *D, double *e);     /* D e = pushed, in place */
void derivatives_costates(const scp_core *core, const derivatives *D, double *nu); /* D'nu = forces, in place */
/* coordinates (C, d) that go with de (N, nx) and du (N, nu), to first order */
void derivatives_positions(const scp_core *core, const derivatives *D, const double *de,
                           const double *du, double *dp);
void lay_out_sensitivity(const scp_core *core, arena *from, sensitivity *by);
int sensitivity_along(scp_core *core, const derivatives *D, sensitivity *by); /* 0, or no numbers */
void respond(const scp_core *core, const derivatives *D, const sensitivity *by, const double *v,
             double sign, double *de, double *du); /* of sign v, inputs only */
/* Second derivatives (nv, nv) in v of stages (N, nx+nu, nx+nu), and sway (N,) in headings or NULL:
 * Transcription._condensed_curvature, symmetric, whole */
void curvature_in_v(scp_core *core, const sensitivity *by, const double *stages, const double *sway,
                    double *W);
/* The change of inputs that is optimal after a drift (N, nx) from a plan that is its own reference;
 * the deviations replace the drift. 0, or no numbers */
int regulate(scp_core *core, const double *A, const double *B, double *drift, double *du);
size_t scratch_of_riccati(const scp_core *core);

/* ---- condensing.c; condensing.py, layout.py */

void lay_out_condensing(scp_core *core, arena *from);
void set_up_condensing(scp_core *core);
void begin_condensing(scp_core *core);                       /* drift of a linear robot */
int roll_out(scp_core *core, const double *U, const double *guess_e, rollout *roll); /* 0, or no numbers */
/* back to a plan whose first state is not the state now: inputs and deviations (N, nx) */
int tracking(scp_core *core, const double *X, const double *U, double *inputs, double *e);
int condense(scp_core *core, const rollout *roll, const double *s, sensitivity *room, condensed *c);
void outputs_of(const scp_core *core, const double *p, const double *s, const double *u,
                const double *e, double *y); /* layout.outputs */
void y_of(const scp_core *core, const condensed *c, const double *v, double *y);
void deviations_of(const scp_core *core, const condensed *c, const double *v, double *e);
size_t scratch_of_condensing(const scp_core *core);

/* ---- certificate.c */

void lay_out_certificate(scp_core *core, arena *from);
void find_planes(scp_core *core, const step *at, const pairs *of, const double *y, planes *to);
/* Residuals of a plan whose y, roll, reaction, pairs, planes, force and slack are there. */
void certify(scp_core *core, nominal *n, relaxation level);
void costates_of(scp_core *core, const rollout *roll, const double *track, const double *reaction,
                 const double *phi, double *nu, double *on_u, double *on_s); /* phi may be NULL */
void phi_of(const scp_core *core, const pairs *of, const planes *at, const double *force, double *phi);
void track_of(const scp_core *core, const double *e, double *track);
/* Smallest curvature of I + W - F'F that active constraints leave; W may be NULL. */
double least_curvature(scp_core *core, int nv, const double *W, int q, const double *factors, int k,
                       const double *rows, const double *force, double *direction);
size_t scratch_of_certificate(const scp_core *core);

/* ---- active_set.c */

void lay_out_active_set(scp_core *core, arena *from);
void lay_out_solution(const scp_core *core, arena *from, solution *s);
/* From a guess in s->active and s->relaxed (zeros: none) to the solution, in at most so many
 * changes; cut off once the dual objective exceeds `limit`. QP_UNSOLVED: not from this guess. */
qp_end settle(scp_core *core, const qp *of, solution *s, int most, double limit, int *systems);
int holds(scp_core *core, const qp *of, const solution *s);
double qp_merit(scp_core *core, const qp *of, const double *v);
double dual_bound(scp_core *core, const qp *of, const double *force);
/* depth (nf + pairs,), negative where a constraint holds, and at which side */
void violations(scp_core *core, const qp *of, const double *v, double *depth, int8_t *side);
void qp_row(const qp *of, int i, double *row); /* (nv,), in v */

/* ---- transcription.c; transcription.py, iterate.py, qp/backend.py */

void lay_out_transcription(scp_core *core, arena *from);
void set_up_transcription(scp_core *core);
size_t scratch_of_transcription(const scp_core *core);
void lay_out_program(const scp_core *core, arena *from, program *p);
void begin_transcription(scp_core *core);
void make_pairs(const scp_core *core, const uint8_t *near, pairs *to);
void near_pairs(scp_core *core, const double *y, const uint8_t *known, uint8_t *near);
int screen(scp_core *core, const nominal *plan, uint8_t *near);
void with_pairs(scp_core *core, const nominal *plan, const uint8_t *near, nominal *to);
/* y and roll of clipped inputs and sizes; 0, or no numbers, like the next two */
int rolled(scp_core *core, const double *U, const double *s, const double *guess_e, nominal *to);
int plain_nominal(scp_core *core, const double *U, const double *guess_e, nominal *to); /* no pairs */
/* an iterate's inputs rolled out from the state now; near (J, C) or NULL for those near it */
int nominal_at(scp_core *core, const scp_iterate *it, const uint8_t *near, const double *about_y,
               nominal *to);
void judge_plan(scp_core *core, nominal *n, const uint8_t *yields, relaxation level);
int obstacle_free_optimum(scp_core *core, const scp_iterate *guess, nominal *to); /* 1: found */
double merit_of(const scp_core *core, double cost, double slack, const double *excess);
/* bounds (ny,) of y; whether they are others than the step's own */
int relaxed_bounds(scp_core *core, relaxation level, const double **lower, const double **upper);
int relaxes(scp_core *core, relaxation *level, int hard);
void write_program(scp_core *core, const nominal *about, const condensed *c, const planes *at,
                   relaxation level, const double *radius, program *to);
void guess_active(const program *p, const double *reaction, const double *force, solution *to);
void guess_nothing(const program *p, solution *to);
qp_end settle_in_time(scp_core *core, const program *p, int changes, double limit, solution *to);
program_end solve_program(scp_core *core, const program *p, const nominal *from, solution *to);
void certified(scp_core *core, const program *p, const solution *s, nominal *to);
void states_of(const scp_core *core, const rollout *roll, double *X);
void iterate_outputs(scp_core *core, const scp_iterate *it, double *y);
void name_iterate(const scp_core *core, const nominal *n, double l1_weight, scp_iterate *to);
int touches(const scp_core *core, const scp_iterate *it);

/* ---- loop.c; loop.py, trust_region.py */

void lay_out_loop(scp_core *core, arena *from);
void set_up_loop(scp_core *core);
size_t scratch_of_loop(const scp_core *core);
/* Descend from a plan. `goal` and `about` may be NULL; limit 0: the settings'. to->there: whether. */
void run_loop(scp_core *core, const nominal *start, const result *goal, const double *about_y,
              int limit, int hard, result *to);
/* `n` may be to->at */
void judge_nominal(scp_core *core, const nominal *n, relaxation level, int iterations, result *to);
int beats(const result *one, const result *other, double lead);

/* ---- newton.c; newton.py, transcription.py's curvature */

void lay_out_newton(scp_core *core, arena *from);
size_t scratch_of_newton(const scp_core *core);
/* Solutions that are valid until the next call. */
const solution *refine(scp_core *core, program *p, const solution *convex);
const solution *second_order_correction(scp_core *core, const program *p, const solution *s,
                                        const nominal *trial);
nominal *restored(scp_core *core, const nominal *plan, nominal *spare, nominal *other); /* or NULL */
double bent_by(scp_core *core, program *p, const solution *convex, const double *v); /* d'W d / 2 */
void second_order(scp_core *core, const program *p, const solution *s, nominal *plan,
                  double *direction); /* (N, nu) */
int negative_curvature_step(scp_core *core, const nominal *saddle, const double *direction,
                            nominal *to);

/* ---- start.c: manoeuvres.py; multi_start.c, candidates.c */

int manoeuvres(scp_core *core, int most, double *U); /* how many; U (most, N, nu) */
size_t scratch_of_start(const scp_core *core);
size_t scratch_of_candidates(const scp_core *core);
typedef struct {
    int obstacle, waits;
    double side[3], time;
    double *path; /* (C, d) */
} candidate_path;
int candidate_paths(scp_core *core, const double *free_path, const double *present, int most,
                    candidate_path *to); /* how many; paths (C, d) of nodes 1 .. C, absolute */
int varied(scp_core *core, const double *path, const uint8_t *touched, int most, double *to); /* (most, C, d) */
int same_pattern(const scp_core *core, const double *path_a, const uint8_t *touched_a,
                 const double *path_b, const uint8_t *touched_b); /* (C, d), (J, C) */
void lay_out_multi_start(scp_core *core, arena *from);
int multi_start_wanted(const scp_core *core, const result *best, int due);
size_t scratch_of_multi_start(const scp_core *core);
void forget_alternatives(scp_core *core); /* those of this step */
void shift_alternatives(scp_core *core);  /* they are those of the step before now */
void ignore_alternatives(scp_core *core); /* nothing is known of the step before */
/* `best` is replaced if another one wins; uses the alternatives of the step before. */
void multi_start(scp_core *core, result *best, const double *free_path, int has_last);

/* ---- fallback.c, backup.c */

void fall_back(scp_core *core, const step *at, const scp_iterate *last, const result *found,
               int brake_first, result *to);
/* Fallback.keep, and brake; `at` may lack obstacles */
void judge_inputs(scp_core *core, const step *at, const double *U, scp_status status, result *to);
void judge_braking(scp_core *core, const step *at, scp_status status, result *to);
/* Fallback.depths (J, C) of inputs, and the states they lead to; whether these are lost */
int depths_of(scp_core *core, const step *at, const double *U, double *X, double *deep);
size_t scratch_of_fallback(const scp_core *core);
void lay_out_backup(scp_core *core, arena *from);
void set_up_backup(scp_core *core);
int backup_of(scp_core *core, const double *X, const double *U, double *inputs); /* steps, -1 for none */
int backup_continued(scp_core *core, const double *x, const double *inputs, int count,
                     double *whole); /* whole (N, nu); 0 if it is not clear any more */
int backup_horizon(const scp_core *core); /* how many intervals it looks ahead */
int backup_always(const scp_core *core); /* whether there is one without any obstacle, too */
size_t scratch_of_backup(const scp_core *core);

/* ---- solver.c, controller.c, clock.c */

void lay_out_solver(scp_core *core, arena *from);
size_t scratch_of_solver(const scp_core *core);
void lay_out_controller(scp_core *core, arena *from);
size_t scratch_of_controller(const scp_core *core);
void solve_step(scp_core *core, const scp_iterate *last, const scp_iterate *last_free, int multi,
                int brake_first);
void write_plan(scp_core *core, const result *best); /* becomes the plan of the step */
void shift_iterate(const scp_core *core, scp_iterate *it); /* in place: one step later */

void begin_clock(scp_core *core);
double elapsed(const scp_core *core);
int allows(scp_core *core, task what);
int room_for(scp_core *core, task what, int most, task then, int spare);
typedef struct { double began, booked; } lap;
lap mark_time(const scp_core *core);
void learn_time(scp_core *core, task what, lap since, int times);

/* ---- memory.c */

/* Numbers on their way to another core, or from one. */
typedef struct {
    double *numbers; /* NULL: they are only counted */
    size_t count;
    int recalls;
} memo;

void memo_doubles(memo *m, size_t n, double *values);
void memo_ints(memo *m, size_t n, int *values);
void memo_controller(scp_core *core, memo *m);   /* controller.c */
void memo_alternatives(scp_core *core, memo *m); /* multi_start.c */

#endif
