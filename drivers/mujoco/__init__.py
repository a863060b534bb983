"""The simulation with MuJoCo: one world per rig; arms and grippers are views of it."""

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="mujoco",
    world="hal.drivers.mujoco.world:MujocoWorld",
    shared_world="hal.drivers.scene.shared:join_world",
    robot="hal.drivers.mujoco.robot:MujocoRobot",
    gripper="hal.drivers.mujoco.gripper:MujocoGripper",
    camera="hal.drivers.scene.camera:SimulatedCamera",
    pictures="hal.drivers.scene.camera:SimulatedPictures",
    pictures_preflight="hal.drivers.scene.camera:check_pictures",
    checks={"camera": "hal.drivers.scene.depth_noise:check"},
    requires={"mujoco": "pip install 'robot-hal[mujoco]'"},
)
