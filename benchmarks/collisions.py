"""Check the verdicts of collisions against PyBullet's, and that motions that would collide are refused or stopped.

    python benchmarks/collisions.py [verdicts|targets|tour|arms|tick|open] [--count N]

Each row is a function that returns its numbers, so that the tests run the same with small counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import hal
from hal.config import load
from hal.kinematics.collision_model import CollisionModel
from hal.specs import BoxSpec, CollisionSpec, RobotSpec

TABLE = BoxSpec("table", (0.55, 0.0, -0.025), (0.0, 0.0, 0.0, 1.0), (1.5, 1.0, 0.05))


def arm(model: str) -> RobotSpec:
    """Return the record of an arm at the origin."""
    return load({"robots": {"arm": {"model": model}}}, sim=True, driver="mock").resolve().robots[0]


def configurations(spec: RobotSpec, count: int, seed: int = 1) -> Iterator[np.ndarray]:
    """Yield random joint positions (n,) within the limits, rad."""
    lower, upper = np.maximum(spec.limits.lower, -np.pi), np.minimum(spec.limits.upper, np.pi)
    yield from np.random.default_rng(seed).uniform(lower, upper, (count, len(spec.joints)))


class Bullet:
    """The shapes of a collision model as bodies of PyBullet."""

    def __init__(self, model: CollisionModel) -> None:
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        self.client: Any = BulletClient(pybullet.DIRECT)
        self.bodies = [self._body(shape) for _, shape, _ in model.shapes()]

    def _body(self, shape: Any) -> int:
        client, kind = self.client, type(shape).__name__
        if kind == "Box":
            one = client.createCollisionShape(client.GEOM_BOX, halfExtents=shape.halfSide.tolist())
        elif kind == "Cylinder":
            one = client.createCollisionShape(client.GEOM_CYLINDER, radius=shape.radius, height=2.0 * shape.halfLength)
        elif kind == "Sphere":
            one = client.createCollisionShape(client.GEOM_SPHERE, radius=shape.radius)
        else:
            one = client.createCollisionShape(client.GEOM_MESH, vertices=np.array(shape.points()).tolist())
        body = int(client.createMultiBody(0.0, one))
        client.changeDynamics(body, -1, collisionMargin=0.0)
        return body

    def place(self, model: CollisionModel) -> None:
        """Move the bodies to where the model's shapes are."""
        for body, (_, _, pose) in zip(self.bodies, model.shapes(), strict=True):
            at = hal.Pose.from_matrix(pose)
            self.client.resetBasePositionAndOrientation(body, at.position.tolist(), at.orientation.tolist())

    def distance(self, i: int, j: int, most: float) -> float:
        """Return the distance of two bodies, m; ``most`` if it is more."""
        points = self.client.getClosestPoints(self.bodies[i], self.bodies[j], most)
        return min((float(point[8]) for point in points), default=most)


def verdicts(model_name: str, count: int) -> dict[str, float]:
    """Compare every pair's verdict in random positions with that of PyBullet's ``getClosestPoints``."""
    spec = arm(model_name)
    model = CollisionModel([spec], CollisionSpec(boxes=(TABLE,), margin=0.0))
    bullet = Bullet(model)
    colliding = differ = unexplained = 0
    worst = 0.0
    for q in configurations(spec, count):
        model.place(q)
        bullet.place(model)
        distances = model.distances()
        collides = bool((distances < 0.0).any())
        colliding += collides
        for k in np.flatnonzero(distances < 0.02):
            theirs = bullet.distance(*model.indices[k], 0.05)
            if distances[k] > 0.0 and theirs < 0.05:
                worst = max(worst, abs(theirs - distances[k]))
            if (theirs < 0.0) != (distances[k] < 0.0):
                differ += 1
                unexplained += max(abs(theirs), abs(distances[k])) >= 1e-3
        for k in np.flatnonzero(distances >= 0.02):  # none of these may touch
            if distances[k] < 0.1 and bullet.distance(*model.indices[k], 0.0) < -1e-3:
                unexplained += 1
    return {
        "configurations": count,
        "colliding": colliding,
        "pairs that differ": differ,
        "of those, by 1 mm or more": unexplained,
        "largest difference of a distance, mm": 1e3 * worst,
    }


ROWS = {"verdicts": lambda count: {m: verdicts(m, count or 10_000) for m in ("panda", "fr3", "iiwa")}}


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], default=[])
    parser.add_argument("--count", type=int, default=0, help="how many of each; default: as many as documented")
    options = parser.parse_args()
    for name in options.rows or ROWS:
        began = time.perf_counter()
        for key, value in ROWS[name](options.count).items():
            print(f"{name:10s} {key}: {value}")
        print(f"{name:10s} took {time.perf_counter() - began:.1f} s\n")


if __name__ == "__main__":
    main()
