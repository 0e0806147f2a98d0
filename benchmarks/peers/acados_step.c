/* One control step of a solver that acados wrote, in one call from Python: acados.py compiles this
 * together with the solver. Parameters and references go in stage by stage, the last plan is
 * shifted, and the new one comes out.
 *
 *     X, U, S     (N+1, nx), (N, nu), (M,): the last plan on entry, the new one at the end
 */
#include <math.h>
#include <string.h>

#include "acados_solver_peer.h"
#include "peer_model/peer_model.h"

#define N PEER_N
#define NX PEER_NX
#define NU PEER_NU
#define P 7
#ifdef PEER_RECENT /* from acados 0.5 on */
#define SET_X0(field, value) ocp_nlp_constraints_model_set(config, dims, in, out, 0, field, value)
#define SET(i, field, value) ocp_nlp_out_set(config, dims, out, in, i, field, value)
#else
#define SET_X0(field, value) ocp_nlp_constraints_model_set(config, dims, in, 0, field, value)
#define SET(i, field, value) ocp_nlp_out_set(config, dims, out, i, field, value)
#endif

typedef struct {
    int obstacles;       /* in this step, at most M */
    int shift;           /* whether X, U are those of the step before */
    int nx, slots;       /* without sizes; M */
    const int *position; /* (2,) */
    double s_min, s_max, s_ref;
    const double *x0, *x_ref;                    /* (nx,), (N+1, nx) */
    const double *means, *covariances, *radii;   /* (M, N+1, 2), (M, N+1, 2, 2), (M,) */
    double *X, *U, *S;
} peer_data;

void *peer_setup(void)
{
    peer_solver_capsule *capsule = peer_acados_create_capsule();
    if (capsule && peer_acados_create(capsule) != 0) {
        peer_acados_free_capsule(capsule);
        return 0;
    }
    return capsule;
}

void peer_free(void *capsule)
{
    peer_acados_free(capsule);
    peer_acados_free_capsule(capsule);
}

void peer_reset(void *capsule)
{
    peer_acados_reset(capsule, 1);
}

static void describe(const double *mean, const double *Sigma, double radius, double *p)
{
    const double middle = 0.5 * (Sigma[0] + Sigma[3]);
    const double half = 0.5 * (Sigma[0] - Sigma[3]);
    const double spread = sqrt(half * half + Sigma[1] * Sigma[1]);
    const double angle = spread > 1e-14 * middle ? 0.5 * atan2(Sigma[1], half) : 0.0;
    p[0] = mean[0];
    p[1] = mean[1];
    p[2] = angle == 0.0 ? 1.0 : cos(angle);
    p[3] = angle == 0.0 ? 0.0 : sin(angle);
    p[4] = fmax(sqrt(middle + spread), 1e-9);
    p[5] = fmax(sqrt(fmax(middle - spread, 0.0)), 1e-9);
    p[6] = radius;
}

static void shift(peer_data *data)
{
    /* The last input is held; f is what acados uses. */
    static const double none[1] = {0.0};
    double state[NX], after[NX], work[1024];
    const double *argument[16] = {state, data->U + (N - 1) * NU, none};
    double *result[16] = {after};
    int integers[256];
    const int nx = data->nx;
    memcpy(state, data->X + N * nx, (size_t)nx * sizeof(double));
    memset(state + nx, 0, (size_t)(NX - nx) * sizeof(double));
    peer_dyn_disc_phi_fun(argument, result, integers, work, 0);
    memmove(data->X, data->X + nx, (size_t)(N * nx) * sizeof(double));
    memcpy(data->X + N * nx, after, (size_t)nx * sizeof(double));
    memmove(data->U, data->U + NU, (size_t)((N - 1) * NU) * sizeof(double));
}

int peer_step(void *solver, peer_data *data)
{
    peer_solver_capsule *capsule = solver;
    ocp_nlp_config *config = peer_acados_get_nlp_config(capsule);
    ocp_nlp_dims *dims = peer_acados_get_nlp_dims(capsule);
    ocp_nlp_in *in = peer_acados_get_nlp_in(capsule);
    ocp_nlp_out *out = peer_acados_get_nlp_out(capsule);
    const int nx = data->nx, M = data->slots;
    double p[PEER_NP + 1], y[NX + NU], low[NX], high[NX];
    if (data->shift)
        shift(data);
    for (int i = 0; i <= N; i++) {
        const double *x_ref = data->x_ref + i * nx;
        for (int j = 0; j < M; j++) {
            double *q = p + P * j;
            const int k = j * (N + 1) + i;
            if (i > 0 && j < data->obstacles) {
                describe(data->means + 2 * k, data->covariances + 4 * k, data->radii[j], q);
            } else { /* far away: older versions constrain the first state, too */
                const double away[P] = {x_ref[data->position[0]] + 100.0,
                                        x_ref[data->position[1]], 1.0, 0.0, 1e-9, 1e-9, 1.0};
                memcpy(q, away, sizeof(away));
            }
        }
        if (M > 0)
            peer_acados_update_params(capsule, i, p, P * M);
        double *x = memcpy(low, data->X + i * nx, (size_t)nx * sizeof(double));
        memcpy(x + nx, data->S, (size_t)(NX - nx) * sizeof(double));
        SET(i, "x", x);
        if (i < N)
            SET(i, "u", data->U + i * NU);
        if (i > 0) {
            memset(y, 0, sizeof(y));
            memcpy(y, x_ref, (size_t)nx * sizeof(double));
            ocp_nlp_cost_model_set(config, dims, in, i, "yref", y);
        }
    }
    for (int k = 0; k < NX; k++) {
        low[k] = k < nx ? data->x0[k] : data->s_min;
        high[k] = k < nx ? data->x0[k] : data->s_max;
    }
    SET_X0("lbx", low);
    SET_X0("ubx", high);
    const int status = peer_acados_solve(capsule);
    if (status != 0 && status != 2) { /* what it holds may be anything */
        peer_acados_reset(capsule, 1);
        return status;
    }
    for (int i = 0; i <= N; i++) {
        ocp_nlp_out_get(config, dims, out, i, "x", y);
        memcpy(data->X + i * nx, y, (size_t)nx * sizeof(double));
        if (i == N)
            memcpy(data->S, y + nx, (size_t)(NX - nx) * sizeof(double));
        else
            ocp_nlp_out_get(config, dims, out, i, "u", data->U + i * NU);
    }
    return status;
}
