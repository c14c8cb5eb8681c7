"""Which parts of an arena are free: blocks are used again as they are, and joined when room runs out."""

from __future__ import annotations

from itertools import chain

__all__ = ["PAGE", "Blocks", "capacity_of"]

PAGE = 4096


def capacity_of(size: int) -> int:
    """Bytes of the block for a message of `size`: whole pages, at most an eighth more than it needs.

    So messages whose size changes a little from ping to ping share blocks.
    """
    step = max(PAGE, 1 << max(size.bit_length() - 4, 0))
    return -(-size // step) * step


class Blocks:
    """Free ranges between `start` and `end`, in multiples of PAGE; from `tail` on all is free."""

    def __init__(self, start: int, end: int) -> None:
        self.tail, self.end = start, end
        self._free: dict[
            int, list[int]
        ] = {}  # offsets by capacity; the last given back is the warmest in cache

    def reuse(self, capacity: int) -> int | None:
        """The offset of a free block of just this capacity."""
        found = self._free.get(capacity)
        return found.pop() if found else None

    def carve(self, capacity: int) -> int | None:
        """The offset of a block at the tail."""
        if self.tail + capacity > self.end:
            return None
        self.tail += capacity
        return self.tail - capacity

    def give(self, offset: int, capacity: int) -> None:
        """Take a block back."""
        self._free.setdefault(capacity, []).append(offset)

    def fit(self, capacity: int) -> int | None:
        """The offset of a block cut from the smallest free range that has room."""
        larger = [found for found, offsets in self._free.items() if found >= capacity and offsets]
        if not larger:
            return None
        whole = min(larger)
        offset = self._free[whole].pop()
        if whole > capacity:
            self.give(offset + capacity, whole - capacity)
        return offset

    def join(self) -> None:
        """Join free neighbours, and the last one with the tail."""
        ranges = sorted(
            chain.from_iterable(((at, at + size) for at in found) for size, found in self._free.items())
        )
        self._free.clear()
        joined: list[tuple[int, int]] = []
        for begin, end in ranges:
            if joined and joined[-1][1] == begin:
                begin = joined.pop()[0]
            joined.append((begin, end))
        if joined and joined[-1][1] == self.tail:
            self.tail = joined.pop()[0]
        for begin, end in reversed(joined):  # low offsets are used first
            self.give(begin, end - begin)
