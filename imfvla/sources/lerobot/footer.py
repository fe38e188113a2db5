"""How many values the columns of a parquet file have, read from its footer.

pyarrow 26 ends the process where it is asked for a column of a footer whose size statistics are damaged. What is read
here is Thrift's compact protocol (https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md)
with the field numbers of parquet.thrift.
"""

from pathlib import Path
from typing import Any

from imfvla.storage.opening import ANYWHERE, DATA, open_to_read, size_of

MAX_FOOTER_BYTES = 64 * 2**20
ROW_GROUPS, COLUMNS, META_DATA, PATH, NUM_VALUES = 4, 1, 3, 3, 5  # fields
STOP, TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT, UUID = range(14)
FIXED = {BYTE: 1, DOUBLE: 8, UUID: 16}  # bytes


def num_values(path: Path) -> list[list[tuple[str, int]]]:
    """Of each row group, the dotted name and the number of values of each column.

    Raises ValueError where the footer is damaged, UserError and OSError as `open_to_read`.
    """
    with open_to_read(path, DATA, home=ANYWHERE) as stream:
        size = size_of(stream)
        stream.seek(max(0, size - 8))
        length = int.from_bytes(stream.read(4), "little")
        if not 0 < length <= min(MAX_FOOTER_BYTES, size - 8):
            raise ValueError(f"its footer is stated to have {length} bytes")
        stream.seek(size - 8 - length)
        data = stream.read(length)
    try:
        groups = _Reader(data).struct()[ROW_GROUPS]
        columns = ([column[META_DATA] for column in group[COLUMNS]] for group in groups)
        return [
            [(b".".join(one[PATH]).decode(), int(one[NUM_VALUES])) for one in of_group]
            for of_group in columns
        ]
    except (IndexError, KeyError, TypeError, RecursionError) as error:
        raise ValueError("its footer is damaged") from error


class _Reader:
    """Reads one value after the other; IndexError at the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def struct(self) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        number = 0
        while (head := self._byte()) != STOP:
            number = number + (head >> 4) if head >> 4 else self._signed()
            kind = head & 15
            fields[number] = kind == TRUE if kind in (TRUE, FALSE) else self._value(kind)
        return fields

    def _value(self, kind: int) -> Any:
        if kind in (I16, I32, I64):
            return self._signed()
        if kind == BINARY:
            return self._bytes(self._varint())
        if kind in (LIST, SET):
            head = self._byte()
            count = head >> 4 if head >> 4 < 15 else self._varint()
            return [self._value(head & 15) for _ in range(count)]
        if kind == MAP:
            count = self._varint()
            kinds = self._byte() if count else 0
            return [(self._value(kinds >> 4), self._value(kinds & 15)) for _ in range(count)]
        if kind == STRUCT:
            return self.struct()
        if kind in (TRUE, FALSE):  # within a list
            return self._byte() == TRUE
        return self._bytes(FIXED[kind])

    def _byte(self) -> int:
        self._place += 1
        return self._data[self._place - 1]

    def _bytes(self, count: int) -> bytes:
        found = self._data[self._place : self._place + count]
        self._place += count
        if len(found) < count:
            raise IndexError
        return found

    def _varint(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 128:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise IndexError
        return value | byte << shift

    def _signed(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
