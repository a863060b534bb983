"""Simulate an arm of your own: its URDF, one YAML file of numbers (xarm6.yaml beside this), and a rig.

python examples/own_arm.py         # needs PyBullet, which the URDF comes with: Python 3.10 or 3.11
"""

from __future__ import annotations

from pathlib import Path

import hal

MODEL = Path(__file__).with_name("xarm6.yaml")
RIG = {"robots": {"arm": {"model": str(MODEL), "workspace": {"table_height": 0.05}}}, "objects": ["floor"]}


def main() -> None:
    """Check the model's numbers: where the tool is at home, and that "up" is up."""
    with hal.open(RIG, clock="lock_step") as rig:
        arm = rig.robots["arm"]
        print(f"{arm.n} joints; at home the tool is at {arm.fk(arm.home).position.round(3)} m")

        before = arm.state().tcp.position
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist(linear=[0.0, 0.0, 0.05]))
                if tick.elapsed > 1.0:
                    break
        moved = arm.state().tcp.position - before
        print(f"a second of 0.05 m/s upwards moved it by {(1000 * moved).round(1)} mm")
        assert moved[2] > 0.03
        assert abs(moved[:2]).max() < 0.005


if __name__ == "__main__":
    main()
