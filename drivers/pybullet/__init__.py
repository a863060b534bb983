"""The simulation: one PyBullet world per rig; arms, grippers and cameras are views of it."""

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="pybullet",
    world="hal.drivers.pybullet.world:World",
    robot="hal.drivers.pybullet.robot:PyBulletRobot",
    gripper="hal.drivers.pybullet.gripper:PyBulletGripper",
    camera="hal.drivers.pybullet.camera:PyBulletCamera",
    pictures="hal.drivers.pybullet.pictures:PyBulletPictures",
    viewer="hal.drivers.pybullet.viewer:PyBulletViewer",
    checks={"camera": "hal.drivers.pybullet.depth_settings:check"},
    requires={"pybullet": "pip install 'robot-hal[sim]'"},
)
