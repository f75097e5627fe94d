"""The thesis's three heads, in physics (thesis sections 6.5 and 6.6).

What the thesis says of them is kept: how many motors, what each turns, when they begin and how long they take, and
that nods recoil. What it does not say (gains, lengths, noise) is ours.
"""

from __future__ import annotations

from typing import Any

from hardware.physics_head import Joint, PhysicsHead

NOBODY = (
    Joint("pan", "right", gain=60, limit=60, offset=(0, 0, 0.05), latency=0.03, quickness=25, mass=0.2),
    Joint("tilt", "up", gain=40, limit=35, offset=(0, 0.01, 0.03), latency=0.03, quickness=25, mass=0.1),
)
DIEGO_SAN = (
    Joint("eye left/right", "right", gain=35, limit=40, latency=0.02, quickness=40, mass=0.05),
    Joint("eye up/down", "up", gain=30, limit=30, latency=0.02, quickness=40, mass=0.05),
)
# In the order of the thesis's commands (eq. 6.8).
EINSTEIN = (
    Joint("eye left/right", "right", 40, 30, (0, 0.08, 0.05), latency=0.13, quickness=15, noise=0.2, mass=0.05),
    Joint("head left/right", "right", 60, 55, (0, 0, 0.08), latency=0.12, quickness=10, noise=0.03, mass=1.2),
    Joint("eye up/down", "up", 30, 25, (0, 0, 0), latency=0.13, quickness=15, noise=0.2, mass=0.05),
    Joint("upper nod", "up", 25, 25, (0, 0.02, 0.06), latency=0.14, quickness=14, damping=0.55, noise=0.12, mass=1.0),
    Joint("lower nod", "up", 25, 25, (0, 0, 0), latency=0.1, quickness=12, damping=0.9, noise=0.03, mass=1.5),
)
# From the foot to the camera: the lower nod carries the head's turn, that the upper nod, that the eyes.
EINSTEIN_CHAIN = (4, 1, 3, 0, 2)


class Nobody(PhysicsHead):
    """A webcam on two servos."""

    def __init__(self, scene: Any, **settings: Any):
        super().__init__(NOBODY, scene, **_with(settings, camera=(0.0, 0.03, 0.02)))


class DiegoSan(PhysicsHead):
    """An eye that two motors turn, mounted a little askew, with a lens that distorts."""

    def __init__(self, scene: Any, **settings: Any):
        super().__init__(DIEGO_SAN, scene, **_with(settings, roll=3.0, distortion=0.05))


class Einstein(PhysicsHead):
    """Five motors: eyes left/right, head left/right, eyes up/down, upper nod, lower nod, in this order (eq. 6.8)."""

    def __init__(self, scene: Any, **settings: Any):
        super().__init__(EINSTEIN, scene, **_with(settings, chain=EINSTEIN_CHAIN))


def _with(settings: dict[str, Any], **defaults: Any) -> dict[str, Any]:
    return defaults | settings
