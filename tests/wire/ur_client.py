"""A program of its own with the unmodified ur_rtde, as its users write it: python ur_client.py HOST."""

from __future__ import annotations

import json
import os
import sys
import time

import dashboard_client
import rtde_control
import rtde_receive

host, done = sys.argv[1], {}
dashboard = dashboard_client.DashboardClient(host)
dashboard.connect()
done["dashboard"] = [dashboard.isInRemoteControl(), dashboard.robotmode(), dashboard.getRobotModel()]
receive = rtde_receive.RTDEReceiveInterface(host)
control = rtde_control.RTDEControlInterface(host)  # uploads its script
start = receive.getActualQ()


def wait_rest() -> list[float]:
    time.sleep(0.2)
    return [b - a for a, b in zip(start, receive.getActualQ(), strict=True)]


control.moveJ([*start[:5], start[5] + 0.4], 1.0, 2.0)
done["moveJ"] = wait_rest()
for k in range(200):
    period = control.initPeriod()
    goal = [*start[:4], start[4] + 0.1 * (k + 1) / 200, start[5] + 0.4]
    control.servoJ(goal, 0.0, 0.0, 0.002, 0.1, 300)
    control.waitPeriod(period)
time.sleep(0.5)
control.servoStop()
done["servoJ"] = wait_rest()
control.speedJ([0.0, 0.0, 0.0, 0.3, 0.0, 0.0], 2.0)
time.sleep(0.6)
done["speed"] = receive.getActualQd()[3]
control.speedStop()
time.sleep(0.1)
done["still"] = [max(map(abs, receive.getActualQd())), control.isProgramRunning()]
jump = receive.getActualQ()
for _ in range(20):  # a target 0.5 rad away is no path
    control.servoJ([jump[0] + 0.5, *jump[1:]], 0.0, 0.0, 0.002, 0.03, 300)
    time.sleep(0.002)
done["jump"] = [receive.isProtectiveStopped(), receive.getActualQ()[0] - jump[0], control.isProgramRunning()]
try:
    dashboard.unlockProtectiveStop()
except RuntimeError as error:
    done["too early"] = str(error)
time.sleep(5.2)
dashboard.unlockProtectiveStop()
time.sleep(0.1)
done["unlocked"] = [receive.isProtectiveStopped(), control.reuploadScript()]
time.sleep(0.3)
done["again"] = control.isProgramRunning()
control.setWatchdog(10.0)
time.sleep(0.5)
done["watchdog"] = control.isProgramRunning()
print(json.dumps(done), flush=True)
os._exit(0)  # its destructors wait
