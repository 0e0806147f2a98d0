/* The control step of a robot among moving obstacles whose positions are Gaussian.
 *
 *     size_t size = scp_size(&problem);            how much memory a controller takes
 *     scp_core *core = scp_setup(&problem, block); lays it out in a block of the caller's
 *     scp_inputs *in = scp_in(core);               write state, reference, obstacles there
 *     scp_solve(core);  or  scp_step(core);        one step, without or with memory of the last one
 *     const scp_outputs *out = scp_out(core);      the plan
 *
 * No allocation, no globals, no input or output. A core belongs to one thread at a time. All arrays
 * are row by row. Angles are in rad, lengths in m, times in s.
 *
 * Notation:
 *     N, nx, nu, d    horizon, states, inputs, dimension of the workspace (2 or 3)
 *     M, J            slots for obstacles, obstacles of a step
 *     K, n, C         instants in an interval, discs of the robot, nodes of a plan: C = N K n
 *     nb              rows E x of bounded states and of speed
 */
#ifndef SCP_MPC_H
#define SCP_MPC_H

#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32)
#define SCP_API __declspec(dllexport)
#elif defined(__GNUC__)
#define SCP_API __attribute__((visibility("default")))
#else
#define SCP_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

enum { SCP_VERSION = 1 };

typedef enum { SCP_LINEAR, SCP_UNICYCLE, SCP_BICYCLE, SCP_OWN_MODEL } scp_model;

typedef enum { SCP_EXACT, SCP_AXES } scp_inflation;

/* How a plan ended; the sentences are those of scp_mpc.Status. The first four are ok. */
typedef enum {
    SCP_CONVERGED,
    SCP_FEASIBLE,
    SCP_PREVIOUS,
    SCP_BRAKING,
    SCP_SOFTENED,
    SCP_STOPPING,
    SCP_VIOLATING,
    SCP_FALLBACK
} scp_status;

/* A model of the caller's own: x_next = f(x, u), at `count` points at once. Each returns 0, or
 * anything else if it has no value there. `share` of an interval passes with the input held; it is
 * 1 for the next sample. With K = 1 no other is asked for. */
typedef struct {
    void *context;
    int (*advance)(void *context, int count, const double *x, const double *u, double share,
                   double *after);
    int (*linearise)(void *context, int count, const double *x, const double *u, double share,
                     double *after, double *A, double *B);
    /* sum_k costates_k (Hessian of f_k in (x, u)): (count, nx+nu, nx+nu) */
    int (*curvature)(void *context, int count, const double *x, const double *u,
                     const double *costates, double share, double *bent);
    /* (nu,) the input that stops the robot within one interval, bounds aside */
    int (*stopping_input)(void *context, const double *x, double *u);
} scp_dynamics;

/* What does not change from step to step: scp_mpc.Problem and Settings in numbers. All pointers are
 * followed during scp_setup only. */
typedef struct {
    int version; /* SCP_VERSION */
    scp_model model;
    int horizon, nx, nu, dim;
    int max_obstacles, instants, discs;
    double dt;
    const int *position;  /* (d,) places in the state */
    int heading;          /* place in the state, -1 for none */
    const int *velocity;  /* (velocities,) places in the state */
    int velocities;
    const double *A, *B;          /* (nx, nx), (nx, nu) of a linear robot */
    const double *stopping;       /* (nu, nx) of a linear robot: u = -stopping x */
    const double *between_x, *between_u; /* ((K-1) d, nx), ((K-1) d, nu): positions between samples */
    const double *bend_x, *bend_u;       /* (K d, nx), (K d, nu): how far a held input bends the way */
    double most_deviation;               /* [m] how far the largest inputs bend it */
    double wheelbase, rear;       /* [m] of a bicycle */
    int substeps;                 /* likewise */
    scp_dynamics own;             /* SCP_OWN_MODEL */
    const double *Q, *R, *Qf;     /* (nx, nx), (nu, nu), (nx, nx) */
    const double *rest;           /* (nu,) equilibrium input */
    const double *moving;         /* (8, nx) states at the origin at 2^-3 .. 2^4 m/s along the first
                                   * axis, from which braking is tried out; NULL: it is not */
    const double *u_min, *u_max;  /* (nu,) */
    int limits_rates;
    const double *du_min, *du_max; /* (nu,) may be infinite */
    int rows;                     /* nb */
    const double *row;            /* (nb, nx) E */
    const double *row_min, *row_max; /* (nb,) may be infinite */
    const uint8_t *row_soft;      /* (nb,) */
    double robot_radius;
    const double *disc;           /* (n,) centres along the heading */
    scp_inflation inflation;
    double s_ref, s_min, s_max, s_weight;
    const double *sizes;          /* (M+1,) uniform size where J obstacles are there; NULL: s_ref */
    const double *backup_sizes;   /* (M+1,) over the horizon of backups, 4 s if that is longer; NULL:
                                   * as `sizes` */
    double joint_risk;            /* to be allocated iteratively; 0: no */
    double growth_time;           /* [s]; 0: the whole horizon */
    double slack_weight, state_slack_weight;
    /* largest numbers of shapes of polytopes in a step, and of their parts; 0: none */
    int max_shapes, max_corners, max_faces, max_edges;
    /* settings */
    double tolerance;
    int max_iterations, max_candidates, max_programs, max_replayed;
    int multi_start, multi_start_interval;
    double deadline;              /* [s]; 0: none */
    double (*clock)(void *context); /* [s]; NULL: none, and no deadline */
    void *clock_context;
} scp_problem;

/* What a step brings. The arrays are there; write into them. */
typedef struct {
    double *x0;          /* (nx,) */
    double *x_ref;       /* (N+1, nx), row 0 is not weighted */
    double *u_last;      /* (nu,) input last applied */
    int has_u_last;
    int count;           /* J */
    double *means;       /* (M, N+1, d), row 0 now */
    double *covariances; /* (M, N+1, d, d) */
    double *radii;       /* (M,) */
    int *shape;          /* (M,) which polytope, -1 for a ball */
    int shapes;          /* polytopes in use, their corners relative to the means */
    int *corners, *faces, *edges; /* (max_shapes,) how many of each */
    double *corner;      /* (max_shapes, max_corners, d) */
    double *normal;      /* (max_shapes, max_faces, d) outward, of length one */
    double *offset;      /* (max_shapes, max_faces) */
    int *edge;           /* (max_shapes, max_edges, 2) pairs of corners; in the plane not needed */
    double *robot_covariance; /* (N+1, d, d) */
    int has_robot_covariance;
    int multi_start;     /* look for other ways past the obstacles in this step */
    int brake_first;     /* where nothing better is found, braking comes before the last plan */
} scp_inputs;

/* A primal-dual point: scp_mpc.scp.iterate.Iterate. Multipliers as there: negative at lower and
 * positive at upper bounds. */
typedef struct {
    double *states, *inputs;  /* (N+1, nx), (N, nu) */
    double *s, *slack;        /* (M,), (M, C) */
    int has_multipliers;
    double *dynamics;         /* (N, nx) */
    double *input_bounds;     /* (N, nu) */
    double *margin;           /* (M,) */
    double *obstacles, *pins; /* (M, C) */
    double *state_bounds;     /* (N, nb) */
    double *rates;            /* (N, nu) */
} scp_iterate;

typedef struct {
    int obstacle;
    double side[3];
    double time, merit;
} scp_candidate;

enum { SCP_MOST_CANDIDATES = 34 };

/* The plan of a step. */
typedef struct {
    scp_status status;
    int iterations;
    double cost, merit;
    double stationarity, feasibility, complementarity, curvature; /* curvature may be NaN */
    int kkt, solved, ranked, cut, infeasible; /* programs by what became of them */
    int switched, candidates;
    scp_candidate candidate[SCP_MOST_CANDIDATES];
    scp_iterate plan, obstacle_free;
    int has_obstacle_free;
    int contact;              /* whether the robot touches an obstacle now */
    double seconds;           /* by the clock that was handed in */
    const double *u0;         /* (nu,) the input to apply */
    int replayed;             /* steps in a row that live on an old plan */
} scp_outputs;

typedef struct scp_core scp_core;

/* 0, or the number of the first member of the problem that is wrong, counted from 1 in the order of
 * the struct; its name by scp_name. */
SCP_API int scp_check(const scp_problem *problem);
SCP_API const char *scp_name(int member);

/* Bytes that a core takes; 0 if the problem is wrong. */
SCP_API size_t scp_size(const scp_problem *problem);

/* Lay a core out in a block of that size, aligned to 64 bytes; NULL if the problem is wrong. */
SCP_API scp_core *scp_setup(const scp_problem *problem, void *block, size_t size);

SCP_API scp_inputs *scp_in(scp_core *core);
SCP_API const scp_outputs *scp_out(const scp_core *core);

/* For scp_solve: the plan to start from, and the one that ignores the obstacles, where another one
 * was found. Write into them and say how many. */
SCP_API scp_iterate *scp_guess(scp_core *core);
SCP_API scp_iterate *scp_guess_free(scp_core *core);

/* 0, or a positive number if an input is wrong (which one: scp_input_name), and nothing happened. */
SCP_API int scp_solve(scp_core *core, int guesses);
SCP_API const char *scp_input_name(int number);

/* The same with memory: starts from the last plan, shifted, keeps a backup. scp_reset forgets. */
SCP_API int scp_step(scp_core *core);
SCP_API void scp_reset(scp_core *core);

/* A step without predictions, as where they are too old: brakes, whatever is in the way. */
SCP_API int scp_brake(scp_core *core);

/* What is left of the last step's backup: inputs (steps, nu). Returns the steps, -1 for no backup. */
SCP_API int scp_backup(const scp_core *core, const double **inputs);

/* What a core remembers of the steps before, for another core of the same problem. */
SCP_API size_t scp_memory_size(scp_core *core); /* how many numbers */
SCP_API void scp_remember(scp_core *core, double *numbers);
SCP_API void scp_recall(scp_core *core, double *numbers);

#ifdef __cplusplus
}
#endif
#endif
