"""The contract of the driver: pytest examples/net_camera"""

from collections.abc import Iterator
from contextlib import contextmanager

from fake_camera import FakeCamera
from net_camera import NetCamera

from hal.testing import CameraBench, CameraContract, bench_of, camera_spec


@contextmanager
def net_camera() -> Iterator[CameraBench]:
    far = FakeCamera()
    far.plug()
    driver = NetCamera(camera_spec(streams=("depth",), options={"host": "127.0.0.1", "port": far.port}))
    yield CameraBench(
        driver=driver,
        patience=2.0,  # s, within which the driver must notice
        lose=far.unplug,
        restore=far.plug,
        freeze=lambda: setattr(far, "frozen", True),
    )
    driver.close()
    far.unplug()


class TestNetCamera(CameraContract):
    bench = bench_of(net_camera)
