/* Signed distance to a convex polytope and its outward normal: scp_mpc/geometry/polytopes.py.
 *
 * Notation:
 *     y       point in the polytope's frame [m]
 *     h(n)    max over the corners v of n'v, the support function [m]
 *     sd      signed distance, max over unit n of n'y - h(n), negative inside
 *     L       (d, d-1) factor of its second derivative: L L'
 *
 * Inside, and wherever the nearest point is on a face, the maximiser is the normal of the face with
 * the largest depth n'y - b. Elsewhere it is that of the ridge next to y (a corner, or in space an
 * edge), and to call it by the wrong name does no harm: no unit n exceeds sd, so the larger value
 * is right.
 */
#include <float.h>

#include "core.h"
#include "small.h"

static const double TIE = 1e-9;   /* [m] of depths below two faces that count as one */
static const double ON_FACE = 1e-9; /* relative; nearer to a face than that is on it */
static const double RIM = 0.9;    /* of the way from a face's middle to its rim */
static const double POINT = 1e-9; /* [m] nearer than that to a corner counts as no nearer */

/* The face with the largest depth; of those equally near from within, the one that looks most
 * towards `side`, where that is given. */
static inline int nearest_face(const int d, const solid *body, const double *y, const double *side,
                               double *depth)
{
    int face = 0;
    *depth = -INFINITY;
    for (int f = 0; f < body->faces; f++) {
        const double deep = inner(d, body->normal + f * d, y) - body->offset[f];
        if (deep > *depth) {
            *depth = deep;
            face = f;
        }
    }
    if (!side || *depth > 0)
        return face;
    double most = -INFINITY;
    const double tied = *depth - TIE;
    for (int f = 0; f < body->faces; f++) {
        const double *n = body->normal + f * d;
        const double deep = inner(d, n, y) - body->offset[f], facing = inner(d, n, side);
        if (deep >= tied && facing > most) {
            most = facing;
            face = f;
            *depth = deep;
        }
    }
    return face;
}

/* The ridge nearest to an outside point, as an offset from it; whether it is an edge's inside. */
static inline int nearest_ridge(const int d, const solid *body, const double *y, double *offset,
                                double *distance)
{
    double least = INFINITY, share = 0.0;
    int ridge = 0;
    for (int r = 0; r < body->ridges; r++) {
        const double *begin = body->begin + r * d, *along = body->along + r * d;
        double away[3], t = 0.0;
        difference(d, y, begin, away);
        if (d > 2) { /* in the plane ridges are corners */
            t = inner(d, away, along) / inner(d, along, along);
            t = t < 0 ? 0.0 : t > 1 ? 1.0 : t;
            for (int l = 0; l < d; l++)
                away[l] -= t * along[l];
        }
        const double distance2 = inner(d, away, away);
        if (distance2 < least) {
            least = distance2;
            ridge = r;
            share = t;
            for (int l = 0; l < d; l++)
                offset[l] = away[l];
        }
    }
    *distance = sqrt(least);
    return share > 0 && share < 1 ? ridge : -1;
}

/* Square to n the distance to a corner is that to a point; along an edge it is flat. */
static void bend_of(int d, const solid *body, int edge, const double *n, double distance,
                    double *bend)
{
    const double stretch = 1.0 / sqrt(larger(distance, POINT));
    if (edge < 0) {
        tangents(d, n, bend);
    } else {
        const double *e = body->along + edge * 3, length = sqrt(inner(3, e, e));
        for (int l = 0; l < 3; l++) {
            const int k = (l + 1) % 3, m = (l + 2) % 3;
            bend[l * 2] = (n[k] * e[m] - n[m] * e[k]) / length;
            bend[l * 2 + 1] = 0.0;
        }
    }
    for (int l = 0; l < d * (d - 1); l++)
        bend[l] *= stretch;
}

static inline double distance_to(const int d, const solid *body, const double *y,
                                 const double *side, double *n, double *bend)
{
    double depth, away[3], distance;
    const int face = nearest_face(d, body, y, side, &depth);
    if (n)
        for (int l = 0; l < d; l++)
            n[l] = body->normal[face * d + l];
    if (bend)
        for (int l = 0; l < d * (d - 1); l++)
            bend[l] = 0.0;
    if (!(depth > 0))
        return depth;
    const int edge = nearest_ridge(d, body, y, away, &distance);
    double reach = -INFINITY;
    for (int l = 0; l < d; l++)
        away[l] /= larger(distance, DBL_MIN);
    for (int v = 0; v < body->corners; v++)
        reach = larger(inner(d, away, body->corner + v * d), reach);
    const double beyond = inner(d, away, y) - reach;
    if (!(beyond > depth))
        return depth;
    if (n)
        for (int l = 0; l < d; l++)
            n[l] = away[l];
    if (bend)
        bend_of(d, body, edge, away, distance, bend);
    return beyond;
}

double solid_distance(int d, const solid *body, const double *y, const double *side, double *n,
                      double *bend)
{
    return d == 2 ? distance_to(2, body, y, side, n, bend) : distance_to(3, body, y, side, n, bend);
}

/* A point on a face near to y, off its rim: from the middle of its corners towards y. */
void solid_over(int d, const solid *body, int face, const double *y, double *to)
{
    const double *n = body->normal + face * d;
    double middle[3] = {0}, way[3] = {0}, size = 0.0, most = 1.0;
    int count = 0;
    for (int v = 0; v < body->corners * d; v++)
        size = larger(size, fabs(body->corner[v]));
    for (int v = 0; v < body->corners; v++) {
        const double *corner = body->corner + v * d;
        if (body->offset[face] - inner(d, corner, n) > ON_FACE * size)
            continue;
        count++;
        for (int l = 0; l < d; l++)
            middle[l] += corner[l];
    }
    for (int l = 0; l < d; l++) {
        middle[l] /= count;
        way[l] = y[l] - middle[l];
    }
    const double up = inner(d, way, n);
    for (int l = 0; l < d; l++)
        way[l] -= up * n[l];
    for (int f = 0; f < body->faces; f++) {
        const double *other = body->normal + f * d, speed = inner(d, way, other);
        if (speed > 0 && inner(d, n, other) <= 1.0 - ON_FACE)
            most = lesser(RIM * (body->offset[f] - inner(d, other, middle)) / speed, most);
    }
    for (int l = 0; l < d; l++)
        to[l] = middle[l] + most * way[l];
}
