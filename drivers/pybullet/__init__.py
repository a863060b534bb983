"""The simulation with PyBullet: one world per rig; arms and grippers are views of it.

What is drawn, and the cameras, are those of :mod:`hal.drivers.scene`.
"""

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="pybullet",
    world="hal.drivers.pybullet.world:PyBulletWorld",
    shared_world="hal.drivers.scene.shared:join_world",
    robot="hal.drivers.pybullet.robot:PyBulletRobot",
    gripper="hal.drivers.pybullet.gripper:PyBulletGripper",
    camera="hal.drivers.scene.camera:SimulatedCamera",
    pictures="hal.drivers.scene.camera:SimulatedPictures",
    software_renderer="hal.drivers.pybullet.tiny:TinyRenderer",
    pictures_preflight="hal.drivers.scene.camera:check_pictures",
    checks={"camera": "hal.drivers.scene.depth_noise:check"},
    requires={"pybullet": "pip install 'robot-hal[sim]' (Python 3.10, 3.11, or a C++ compiler)"},
)
