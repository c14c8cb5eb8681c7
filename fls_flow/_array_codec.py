"""How arrays stand in a buffer: dtype and shape in its header, the cells in a segment of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow._codecs import Writer, short, unfit
from fls_flow._generated import Code
from fls_flow.errors import WireError

__all__ = ["DTYPES", "Array", "aligned"]

ALIGNMENT = 64  # a cache line, and more than any SIMD load asks for
_MAX_NDIM = 32
DTYPES = {
    code: np.dtype("<" + code)
    for code in ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16")
}


@dataclass(frozen=True, slots=True)
class Array:
    """dtype, number of dimensions and their lengths in the header; the cells in a segment of their own."""

    where: str
    dtypes: dict[str, np.dtype[Any]]  # those allowed
    dims: str  # as the class declares them

    @property
    def text(self) -> str:
        return f"[{' '.join(self.dtypes)}]{self.dims}"

    def write(self, value: str, code: Writer) -> None:
        dtype, first = code.name(), next(iter(self.dtypes.values()))
        with code.block(f"if type({value}) is not {code.uses(np.ndarray)}"):
            code.line(f"{value} = {code.uses(np.asarray)}({value})")
        usual = f"{value}.dtype is {code.uses(first)} and {first.kind != 'b'}"
        code.line(f"{dtype} = {code.uses(first)} if {usual} else {code.uses(self.dtype)}({value})")
        with code.block(f"if {value}.size"):
            code.line(f"arrays.append(({value}, {dtype}))")
        name = repr(first.str[1:]) if len(self.dtypes) == 1 else f"{dtype}.str[1:]"
        code.item(name, f"{value}.ndim", f"*{value}.shape")

    def dtype(self, array: npt.NDArray[Any]) -> np.dtype[Any]:
        """The cells' dtype on the wire."""
        found = self.dtypes.get(array.dtype.str[1:])
        if found is None or array.ndim > _MAX_NDIM:
            what = f"{self.where} has dtype {array.dtype} and {array.ndim} dimensions"
            raise WireError(f"{what}; it takes {', '.join(self.dtypes)} and at most {_MAX_NDIM}")
        if found.kind == "b":
            _check_bools(self.where, array)
        return found

    def read(self, code: Code) -> str:
        value = code.name()
        code.line(f"{value}, end = {code.uses(self.array)}(take, view, end)")
        return value

    def array(self, take: Callable[[], Any], view: memoryview, end: int) -> tuple[npt.NDArray[Any], int]:
        """The next segment, as a read-only view, and where it ends."""
        code, ndim = take(), take()
        dtype = self.dtypes.get(code) if type(code) is str else None
        if dtype is None:
            unfit(self.where, code, f"dtype {', '.join(self.dtypes)}")
        if type(ndim) is not int or not 0 <= ndim <= _MAX_NDIM:
            unfit(self.where, ndim, f"0 to {_MAX_NDIM} dimensions")
        shape: list[int] = []
        count = 1
        for _ in range(ndim):
            length = take()
            if type(length) is not int or length < 0:
                unfit(self.where, (*shape, length), "lengths as its shape")
            shape.append(length)
            count *= length
        if count == 0:
            return _empty(self.where, dtype, shape), end
        start = -(-end // ALIGNMENT) * ALIGNMENT
        end = start + count * dtype.itemsize
        if end > len(view):
            raise WireError(f"{self.where} has shape {short(shape)} of {dtype}: more than the buffer holds")
        # Not ndarray(buffer=...), which would let the buffer be resized or closed under the array.
        found: npt.NDArray[Any] = np.frombuffer(view, dtype, count, start)
        if dtype.kind == "b":
            _check_bools(self.where, found)
        return found if ndim == 1 else found.reshape(shape), end


def _empty(where: str, dtype: np.dtype[Any], shape: list[int]) -> npt.NDArray[Any]:
    try:
        empty = np.empty(shape, dtype)
    except (ValueError, OverflowError, MemoryError) as error:  # a length beyond numpy's beside a zero
        raise WireError(f"{where} has shape {short(shape)}: {error}") from error
    empty.flags.writeable = False
    return empty


def _check_bools(where: str, array: npt.NDArray[Any]) -> None:
    """Raise at bytes that are neither 0 nor 1: numpy takes them for bools and then counts them wrongly."""
    if array.size and array.view(np.uint8).max() > 1:
        raise WireError(f"{where} holds bytes other than 0 and 1: use `!= 0`, not `.view(bool)`")


def aligned(offset: int) -> int:
    """Where a segment begins that follows byte `offset`."""
    return -(-offset // ALIGNMENT) * ALIGNMENT
