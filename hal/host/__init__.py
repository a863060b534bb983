"""Where a group of devices runs: one cycle, in the caller's process or in one of its own.

``cycle`` is what happens once per period; ``hosts`` is where it runs, as the app sees it; ``main`` is the process of a
group in real time. They stand on ``records`` (the layouts of everything that is exchanged), ``memory`` and ``ring``
(shared memory), ``process`` (child processes) and ``scheduling``. Nothing is imported here: a child process starts with
``process`` alone.
"""
