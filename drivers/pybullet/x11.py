"""Which keys are down while a window has the focus, asked of the X server itself.

Events are not enough: a window that loses the focus while a key is held never sees its release. The server's own
table of keys has no such gap, and asking who has the focus makes a lost one a release.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from collections.abc import Iterable, Iterator
from typing import Any

__all__ = ["Keyboard", "NoDisplay", "windows"]

_POINTER_ROOT = 1
"""The focus of a server without a window manager: whatever the pointer is in."""
_DEPTH = 4
"""How deep window managers nest a program's windows."""


class NoDisplay(Exception):
    """There is no X server to talk to."""


class Keyboard:
    """The keys of a display, for as long as ``window`` has the focus.

    Args:
        names: X's names of keys ("keysyms") to look at.
        window: X's number of the window.

    Raises:
        NoDisplay: libX11 is missing, or no server answers.
    """

    def __init__(self, names: Iterable[str], window: int) -> None:
        self._x = _library()
        self._display = _open(self._x)
        self._window = window
        self._old: set[str] = set()
        """Down since before the window had the focus: they count when they were up once."""
        self._codes = {name: self._x.XKeysymToKeycode(self._display, _keysym(self._x, name)) for name in names}

    def held(self) -> frozenset[str]:
        """Names of the keys that were pressed while the window had the focus, and are still down; else none."""
        focused = self._focused()
        table = ctypes.create_string_buffer(32)
        self._x.XQueryKeymap(self._display, table)
        down = {name for name, code in self._codes.items() if code and table.raw[code >> 3] >> (code & 7) & 1}
        self._old = self._old & down if focused else down
        return frozenset(down - self._old)

    def present(self) -> bool:
        """Is the window still there?"""
        return _family(self._x, self._display, self._window) is not None

    def _focused(self) -> bool:
        focus, revert = ctypes.c_ulong(), ctypes.c_int()
        self._x.XGetInputFocus(self._display, ctypes.byref(focus), ctypes.byref(revert))
        window = focus.value
        if window == _POINTER_ROOT:
            window = self._under_pointer()
        for _ in range(_DEPTH):  # the window itself, or one inside it
            if window == self._window:
                return True
            family = _family(self._x, self._display, window)
            if family is None:
                return False
            window = family[0]
        return False

    def _under_pointer(self) -> int:
        root = self._x.XDefaultRootWindow(self._display)
        unused, child = ctypes.c_ulong(), ctypes.c_ulong()
        place = [ctypes.byref(ctypes.c_int()) for _ in range(4)]
        self._x.XQueryPointer(
            self._display, root, ctypes.byref(unused), ctypes.byref(child), *place, ctypes.byref(ctypes.c_uint())
        )
        return child.value

    def close(self) -> None:
        """Hang up. Idempotent."""
        if self._display:
            self._x.XCloseDisplay(self._display)
            self._display = None


def windows(title: str) -> frozenset[int]:
    """Numbers of all windows whose title contains ``title``. Raises NoDisplay."""
    x = _library()
    display = _open(x)
    try:
        return frozenset(_search(x, display, x.XDefaultRootWindow(display), title, _DEPTH))
    finally:
        x.XCloseDisplay(display)


def _search(x: Any, display: Any, window: int, title: str, depth: int) -> Iterator[int]:
    name = ctypes.c_char_p()
    if x.XFetchName(display, window, ctypes.byref(name)) and name.value is not None:
        if title.encode() in name.value:
            yield window
        x.XFree(name)
    if depth:
        family = _family(x, display, window)
        for child in family[1] if family else ():
            yield from _search(x, display, child, title, depth - 1)


def _family(x: Any, display: Any, window: int) -> tuple[int, list[int]] | None:
    """A window's parent, 0 for none, and its children; None when there is no such window."""
    root, parent, count = ctypes.c_ulong(), ctypes.c_ulong(), ctypes.c_uint()
    children = ctypes.POINTER(ctypes.c_ulong)()
    found = x.XQueryTree(
        display,
        window,
        ctypes.byref(root),
        ctypes.byref(parent),
        ctypes.byref(children),
        ctypes.byref(count),
    )
    if not found:
        return None
    numbers = [children[k] for k in range(count.value)]
    if count.value:
        x.XFree(children)
    return parent.value, numbers


def _keysym(x: Any, name: str) -> int:
    return int(x.XStringToKeysym(name.encode()))


def _open(x: Any) -> Any:
    display = x.XOpenDisplay(None)
    if not display:
        raise NoDisplay("no display answers; is the variable DISPLAY right?")
    return ctypes.c_void_p(display)


def _library() -> Any:
    """libX11 with the types of what is called here; errors about windows that are gone are not fatal."""
    name = ctypes.util.find_library("X11")
    if name is None:
        raise NoDisplay("libX11 is not installed: apt install libx11-6")
    x = ctypes.CDLL(name)
    x.XOpenDisplay.restype = ctypes.c_void_p
    x.XDefaultRootWindow.restype = ctypes.c_ulong
    x.XDefaultRootWindow.argtypes = [ctypes.c_void_p]
    x.XStringToKeysym.restype = ctypes.c_ulong
    x.XKeysymToKeycode.argtypes = [ctypes.c_void_p, ctypes.c_ulong]
    x.XKeysymToKeycode.restype = ctypes.c_ubyte
    x.XFetchName.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p]
    x.XQueryTree.argtypes = [ctypes.c_void_p, ctypes.c_ulong, *[ctypes.c_void_p] * 4]
    x.XQueryPointer.argtypes = [ctypes.c_void_p, ctypes.c_ulong, *[ctypes.c_void_p] * 7]
    x.XGetInputFocus.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    x.XQueryKeymap.argtypes = [ctypes.c_void_p, ctypes.c_char_p]
    x.XCloseDisplay.argtypes = [ctypes.c_void_p]
    x.XFree.argtypes = [ctypes.c_void_p]
    x.XSetErrorHandler.argtypes = [ctypes.c_void_p]
    x.XSetErrorHandler(ctypes.cast(_HANDLER, ctypes.c_void_p))
    return x


def _ignore(display: Any, event: Any) -> int:
    return 0


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(_ignore)
