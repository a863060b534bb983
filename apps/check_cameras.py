"""Which cameras are plugged in, with what a rig needs to name each of them: ``hal-check --cameras``."""

from __future__ import annotations

__all__ = ["show_cameras"]


def show_cameras() -> bool:
    """Print what every driver finds. False where no camera is plugged in."""
    from hal import registry
    from hal.errors import HalError

    found = False
    for name in registry.names():
        try:
            if registry.driver(name).camera is None:
                continue
            missing = registry.missing(name)
            if missing:
                print(f"{name:12s} its library is not installed: {', '.join(missing.values())}")
                continue
            driver = registry.load(name, "camera")
            if driver.simulated:
                continue
            plugged = driver.plugged()
        except (HalError, OSError) as error:
            print(f"{name:12s} {type(error).__name__}: {error}")
            continue
        for camera in plugged or ("no camera",):
            print(f"{name:12s} {camera}")
        found = found or bool(plugged)
    return found
