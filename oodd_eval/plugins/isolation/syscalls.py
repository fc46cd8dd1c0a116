"""System calls that a sandbox refuses: those by which its processes could reach others.

Namespaces keep memory, names and numbers of two sandboxes apart, but both read the same files of
the system. Locks on such a file, watches of it, or the question whether it lies in memory would
carry messages from one to the other; so would key rings, the kernel's log and sockets to virtual
machines, of which there is one for all namespaces.
"""

import platform
import struct
from collections.abc import Iterable, Iterator
from typing import Final

from oodd_eval.errors import UsageError

_MACHINES: Final = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""Audit number of each architecture, and its column below."""

_REFUSED: Final = {
    # Locks and watches of files that all sandboxes read.
    "flock": (73, 32),
    "inotify_init": (253, None),
    "inotify_init1": (294, 26),
    "fanotify_init": (300, 262),
    # Which parts of such a file lie in memory, as somebody has read them.
    "mincore": (27, 232),
    "cachestat": (451, 451),
    "fadvise64": (221, 223),
    "readahead": (187, 213),
    "preadv2": (327, 286),
    "pwritev2": (328, 287),
    "io_setup": (206, 0),
    "io_uring_setup": (425, 425),
    # What all processes of the system share.
    "add_key": (248, 217),
    "request_key": (249, 218),
    "keyctl": (250, 219),
    "syslog": (103, 116),
    "perf_event_open": (298, 241),
    "bpf": (321, 280),
    "userfaultfd": (323, 282),
    # Namespaces, in which a process has rights again.
    "unshare": (272, 97),
    "setns": (308, 268),
    "clone3": (435, 435),
}
_FCNTL: Final = (72, 25)
_LOCKS: Final = (5, 6, 7, 36, 37, 38, 1024, 1025, 1026)  # locks, leases and watches by fcntl
_CLONE: Final = (56, 220)
_NAMESPACES: Final = 0x7E020000  # flags of clone
_SOCKETS: Final = ((41, 198), (53, 199))  # socket, socketpair
_FAMILIES: Final = (1, 2, 10, 16)  # AF_UNIX, AF_INET, AF_INET6, AF_NETLINK: each has namespaces

_NUMBER, _MACHINE, _FIRST, _SECOND = 0, 4, 16, 24  # offsets in what the kernel shows a filter
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _KILL, _REFUSE = 0x7FFF0000, 0x80000000, 0x00050000 | 38  # ENOSYS: programs know it
_OTHER_NUMBERS: Final = 0x40000000  # those of x32 begin here

_Instruction = tuple[int, int, int, int]  # code, jumps if true and if false, number


def syscall_filter() -> bytes:
    """Return the filter of this architecture as bubblewrap reads it; `UsageError` for others."""
    if platform.machine() not in _MACHINES:
        known = " and ".join(_MACHINES)
        raise UsageError(f"--sandbox is for {known}, not for {platform.machine()}")
    audit, column = _MACHINES[platform.machine()]
    program: list[_Instruction] = [
        (_LOAD, 0, 0, _MACHINE),
        (_EQUAL, 1, 0, audit),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER),
        *_when(_AT_LEAST, [_OTHER_NUMBERS], _REFUSE),
        *_when(_EQUAL, (n for row in _REFUSED.values() if (n := row[column]) is not None), _REFUSE),
    ]
    for number, argument, answers in (
        (_FCNTL, _SECOND, [*_when(_EQUAL, _LOCKS, _REFUSE), (_RETURN, 0, 0, _ALLOW)]),
        (_CLONE, _FIRST, [*_when(_ANY_BIT, [_NAMESPACES], _REFUSE), (_RETURN, 0, 0, _ALLOW)]),
        *(
            (socket, _FIRST, [*_when(_EQUAL, _FAMILIES, _ALLOW), (_RETURN, 0, 0, _REFUSE)])
            for socket in _SOCKETS
        ),
    ):
        block = [(_LOAD, 0, 0, argument), *answers]
        program += [(_EQUAL, 0, len(block), number[column]), *block]
    program.append((_RETURN, 0, 0, _ALLOW))
    return b"".join(struct.pack("=HBBI", *instruction) for instruction in program)


def _when(test: int, numbers: Iterable[int], verdict: int) -> Iterator[_Instruction]:
    """Yield instructions that end with a verdict when a test of what is loaded is true."""
    for number in numbers:
        yield from ((test, 0, 1, number), (_RETURN, 0, 0, verdict))
