"""Where a group of devices runs: one cycle, in the caller's process or in one of its own.

``cycle`` is what happens once per period; ``hosts`` is where, as the app sees it; ``main`` is the process of a group in
real time; ``process``, ``mailbox``, ``records`` and ``pacer`` are what it is made of. Nothing is imported here: a child
process starts with ``process`` alone.
"""
