"""A rig over two computers: ``hal serve`` at the devices, ``at: ADDRESS`` in a rig anywhere.

The seam is the mailbox. A process at each end copies the newest record of each mailbox over one TCP connection, so that
program and host each see memory of their own computer, and nothing above or below knows::

    program ── memory ── client ════ TCP, TLS ════ server ── memory ── host (servo, watchdog, driver)
             commands, dead-man, sessions, heartbeat ──►     ◄── states, grippers

* :mod:`.link`: frames over a connection, and how the clocks of its ends are related. Each frame has the newest record
  of every mailbox of its direction, and a number: one that is lost, late, repeated or out of order changes nothing but
  freshness. Nothing queues: while the connection does not take a frame, the next one is not made.
* :mod:`.boxes`: the records of a direction. Their times are translated into the reader's monotonic clock on arrival,
  and none is later than its arrival. Two wall clocks are never compared.
* :mod:`.client`: the process in place of a host. It starts, answers, fails and ends as a host's process does.
* :mod:`.server`: lends the hosts of its open rig to a client, and takes them back, at rest, when that client leaves.
  The next one has other sessions and a dead-man that was not pressed yet: nothing resumes.
* :mod:`.frames` and :mod:`.pads`: pictures of a camera, readings of a gamepad, each over a connection of its own.
* :mod:`.entrance`: who is let in, with which certificate (:mod:`hal.keys`). :mod:`.measure`: what a link is good for.

**The dead-man is end to end.** The server never makes a sign of life. That of the program (its heartbeat, the stamp of
the dead-man) is translated by the middle of the bounds that the exchanged stamps prove for the offset of the clocks, so
it is wrong by half a round trip at most, and the servo's watchdog trips after its usual 150 ms.

TCP with TLS of the standard library, not Zenoh: 256 bytes there and back took 0.11 ms with mutual TLS against 0.34 ms,
less than half of the processor's time, no library of 34 MB, and no thread of another library in this process.
"""
