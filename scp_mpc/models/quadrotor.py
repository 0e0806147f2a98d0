"""The quadrotor in space, driven by thrust and body rates: its fast inner loop is the autopilot's.

Notation:
    x = [p, v, phi, theta, psi]     position (3,) [m], z up, velocity (3,) [m/s], roll, pitch and
                                    yaw [rad]: turned by psi about z, theta about y, phi about x
    u = [T, q1, q2, q3]             thrust per mass [m/s^2], body rates [rad/s]
    b (3,)                          the rotors' axis, R e_3
    g                               gravity [m/s^2]
    turn = q2 sin phi + q3 cos phi,  tilt = q2 cos phi - q3 sin phi
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray, as_count, frozen
from scp_mpc.models.model import as_period, indices
from scp_mpc.models.planar_quadrotor import HoveringModel, as_gravity


@dataclass(frozen=True, eq=False)
class Quadrotor(HoveringModel):
    """p' = v, v' = T b - g e_3, and the attitude follows the body rates.

        phi' = q1 + tan(theta) turn,  theta' = tilt,  psi' = turn / cos(theta)

        x = [p1, p2, p3, v1, v2, v3, phi, theta, psi]   position [m], z up, velocity [m/s], roll,
                                                        pitch and yaw [rad]
        u = [T, q1, q2, q3]                             thrust per mass [m/s^2], body rates [rad/s]

    Singular at theta = +-pi/2, the nose straight up or down: bound the pitch where a plan might
    come near. Upside down about the roll axis is regular.

    Args:
        dt: Sampling time [s].
        gravity: g [m/s^2].
        substeps: Runge-Kutta steps per interval.

    Raises:
        BoundsError: dt or the gravity is not positive, or there is no step.
    """

    dt: float
    gravity: float = 9.81
    substeps: int = 1

    nx = 9
    nu = 4
    position = indices(0, 1, 2)
    velocity = indices(3, 4, 5)

    def __post_init__(self) -> None:
        """Check the numbers."""
        object.__setattr__(self, "dt", as_period(self.dt))
        object.__setattr__(self, "gravity", as_gravity(self.gravity))
        object.__setattr__(self, "substeps", as_count("substeps", self.substeps))

    @cached_property
    def equilibrium_input(self) -> FloatArray:
        """Hover: thrust against gravity."""
        return frozen(np.array([self.gravity, 0.0, 0.0, 0.0]))

    def rates(self, x: Any, u: Any, lib: Any) -> tuple[Any, ...]:
        """Return the nine rates of change."""
        _, _, _, v1, v2, v3, phi, theta, psi = x
        T, q1, q2, q3 = u
        cf, sf, ct, st = lib.cos(phi), lib.sin(phi), lib.cos(theta), lib.sin(theta)
        cp, sp = lib.cos(psi), lib.sin(psi)
        lean = st * cf
        yawing = (q2 * sf + q3 * cf) / ct
        return (
            v1,
            v2,
            v3,
            T * (cp * lean + sp * sf),
            T * (sp * lean - cp * sf),
            T * (ct * cf) - self.gravity,
            q1 + st * yawing,
            q2 * cf - q3 * sf,
            yawing,
        )

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., 9, 13) at states (..., 9) and inputs (..., 4)."""
        T, q2, q3 = inputs[..., 0], inputs[..., 2], inputs[..., 3]
        angles = [states[..., i] for i in (6, 7, 8)]
        (cf, ct, cp), (sf, st, sp) = map(np.cos, angles), map(np.sin, angles)
        turn, tilt, tangent = q2 * sf + q3 * cf, q2 * cf - q3 * sf, st / ct
        lean, drop = st * cf, st * sf
        yawing = turn / ct
        slopes = np.zeros((*T.shape, 9, 13))
        for i in range(3):
            slopes[..., i, 3 + i] = 1.0
        b1, b2, b3 = cp * lean + sp * sf, sp * lean - cp * sf, ct * cf
        entries = {
            (3, 6): T * (sp * cf - cp * drop),
            (3, 7): T * (cp * b3),
            (3, 8): -T * b2,
            (3, 9): b1,
            (4, 6): -T * (sp * drop + cp * cf),
            (4, 7): T * (sp * b3),
            (4, 8): T * b1,
            (4, 9): b2,
            (5, 6): -T * (ct * sf),
            (5, 7): -T * lean,
            (5, 9): b3,
            (6, 6): tangent * tilt,
            (6, 7): yawing / ct,
            (6, 10): 1.0,
            (6, 11): tangent * sf,
            (6, 12): tangent * cf,
            (7, 6): -turn,
            (7, 11): cf,
            (7, 12): -sf,
            (8, 6): tilt / ct,
            (8, 7): yawing * tangent,
            (8, 11): sf / ct,
            (8, 12): cf / ct,
        }
        for (row, column), entry in entries.items():
            slopes[..., row, column] = entry
        return slopes

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., 13, 13), for weights m (..., 9)."""
        T, q2, q3 = inputs[..., 0], inputs[..., 2], inputs[..., 3]
        angles = [states[..., i] for i in (6, 7, 8)]
        (cf, ct, cp), (sf, st, sp) = map(np.cos, angles), map(np.sin, angles)
        m3, m4, m5, m6, m7, m8 = (weights[..., i] for i in range(3, 9))
        # the thrust's weights ahead of and beside the nose
        ahead, beside = m3 * cp + m4 * sp, m3 * sp - m4 * cp
        upright, sideways = ahead * st + m5 * ct, ahead * ct - m5 * st
        # the rates': weight of the turn rate, with its two derivatives in pitch
        rise = (m6 + m8 * st) / ct**2
        w = (m6 * st + m8) / ct
        bend = m8 / ct + 2.0 * (st / ct) * rise
        turn, tilt = q2 * sf + q3 * cf, q2 * cf - q3 * sf
        bent = np.zeros((*T.shape, 13, 13))
        entries = {
            (6, 6): -T * (upright * cf + beside * sf) - w * turn - m7 * tilt,
            (6, 7): rise * tilt - T * (sideways * sf),
            (6, 8): T * (beside * st * sf + ahead * cf),
            (7, 7): bend * turn - T * (upright * cf),
            (7, 8): -T * (beside * ct * cf),
            (8, 8): -T * (ahead * st * cf + beside * sf),
            (6, 9): beside * cf - upright * sf,
            (7, 9): sideways * cf,
            (8, 9): ahead * sf - beside * st * cf,
            (6, 11): w * cf - m7 * sf,
            (6, 12): -w * sf - m7 * cf,
            (7, 11): rise * sf,
            (7, 12): rise * cf,
        }
        for (row, column), entry in entries.items():
            bent[..., row, column] = bent[..., column, row] = entry
        return bent

    def stop(self, x: Any, lib: Any) -> tuple[Any, ...]:
        """Return thrust that slows the speed down, and body rates towards its attitude.

        Within ten intervals, at half of gravity at most; the attitude within two, at the same yaw.
        """
        g, rate = self.gravity, 0.5 / self.dt
        _, _, _, v1, v2, v3, phi, theta, psi = x
        f1, f2, up = (lib.fmin(lib.fmax(-v * rate / 5, -g / 2), g / 2) for v in (v1, v2, v3))
        f3 = g + up
        (cf, ct, cp), (sf, st, sp) = ([f(a) for a in (phi, theta, psi)] for f in (lib.cos, lib.sin))
        ahead, left = cp * f1 + sp * f2, cp * f2 - sp * f1
        pitching = rate * (lib.atan2(ahead, f3) - theta)
        rolling = rate * (lib.atan2(-left, lib.hypot(ahead, f3)) - phi)
        lift = (ahead * st + f3 * ct) * cf - left * sf
        return lib.fmax(lift, 0.0), rolling, pitching * cf, -pitching * sf

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., 9) there, level at yaw 0, with velocities (..., 3)."""
        return np.concatenate([position, velocity, np.zeros(np.shape(position))], axis=-1)
