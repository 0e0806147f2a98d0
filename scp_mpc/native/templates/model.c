
/* ---- what CasADi wrote, as scp_dynamics */

#include <math.h>
#include <string.h>

#include "scp_mpc.h"

enum { NX = @nx@, NU = @nu@, D = @d@, N = NX + NU };

static const int position[D] = {@position@};
static const double rest[NU] = {@rest@};

typedef int function(const double **, double **, casadi_int *, double *, int);

static int call(function *f, const double *const in[3], double *const out[3])
{
    const double *arg[@arguments@] = {0};
    double *res[@results@] = {0}, w[@reals@];
    casadi_int iw[@integers@];
    memcpy(arg, in, 3 * sizeof *in);
    memcpy(res, out, 3 * sizeof *out);
    return f(arg, res, iw, w, 0);
}

static void join(const double *x, const double *u, double *z)
{
    memcpy(z, x, NX * sizeof *z);
    memcpy(z + NX, u, NU * sizeof *z);
}

static int advance(void *context, int count, const double *x, const double *u, double share,
                   double *after)
{
    (void)context;
    for (int i = 0; i < count; i++) {
        double z[N], *const out[3] = {after + i * NX};
        const double *const in[3] = {z, &share};
        join(x + i * NX, u + i * NU, z);
        if (call(@name@_advance, in, out))
            return 1;
    }
    return 0;
}

static int linearise(void *context, int count, const double *x, const double *u, double share,
                     double *after, double *A, double *B)
{
    (void)context;
    for (int i = 0; i < count; i++) {
        double z[N], *const out[3] = {after + i * NX, A + i * NX * NX, B + i * NX * NU};
        const double *const in[3] = {z, &share};
        join(x + i * NX, u + i * NU, z);
        if (call(@name@_linearise, in, out))
            return 1;
    }
    return 0;
}

static int curvature(void *context, int count, const double *x, const double *u,
                     const double *costates, double share, double *bent)
{
    (void)context;
    for (int i = 0; i < count; i++) {
        double z[N], *const out[3] = {bent + i * N * N}, any = 0;
        const double *y = costates + i * NX, *const in[3] = {z, y, &share};
        for (int k = 0; k < NX; k++)
            any += fabs(y[k]);
        memset(out[0], 0, N * N * sizeof *bent);
        join(x + i * NX, u + i * NU, z);
        if (any != 0 && call(@name@_curvature, in, out)) /* obstacles push few nodes */
            return 1;
    }
    return 0;
}
