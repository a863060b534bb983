"""The simulation: one PyBullet world per rig; arms, grippers and cameras are views of it.

What is independent of the physics engine stands in files that do not use PyBullet: :mod:`.scene`, :mod:`.meshes`,
:mod:`.renderer` and :mod:`.exposure`.
"""

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="pybullet",
    world="hal.drivers.pybullet.world:PyBulletWorld",
    robot="hal.drivers.pybullet.robot:PyBulletRobot",
    gripper="hal.drivers.pybullet.gripper:PyBulletGripper",
    camera="hal.drivers.pybullet.camera:PyBulletCamera",
    pictures="hal.drivers.pybullet.camera:PyBulletPictures",
    viewer="hal.drivers.pybullet.viewer:PyBulletViewer",
    checks={"camera": "hal.drivers.pybullet.exposure:check"},
    requires={"pybullet": "pip install 'robot-hal[sim]'"},
)
