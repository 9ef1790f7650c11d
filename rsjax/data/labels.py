"""Labels of the records of a split, in a file of their own, so that records can be chosen by label without being read.

A label is a word in a column, such as ``simple`` in ``difficulty``. Columns are stored as int32 codes of their words.
"""

import fnmatch
import io
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32

from rsjax.data.codec import Record
from rsjax.files import regular

Words = dict[str, str]  # a record's word in each column
Label = Callable[[Record], Words]  # the columns are always the same


class LabelWriter:
    """Collects the labels of records as they are written, in order, and writes them to one file."""

    def __init__(self) -> None:
        self._words: dict[str, dict[str, int]] = {}
        self._codes: dict[str, array[int]] = {}

    def noting(self, records: Iterable[Record], label: Label) -> Iterator[Record]:
        """Yields the same records and collects the labels of each."""
        for record in records:
            for name, word in label(record).items():
                words = self._words.setdefault(name, {})
                self._codes.setdefault(name, array("i")).append(words.setdefault(word, len(words)))
            yield record

    def write(self, path: Path) -> dict[str, Any]:
        """Writes the codes of at least one record and returns the file's entry in the manifest."""
        buffer = io.BytesIO()
        np.save(buffer, np.stack([np.asarray(codes, np.int32) for codes in self._codes.values()]))
        payload = buffer.getvalue()
        path.write_bytes(payload)
        words = {name: list(words) for name, words in self._words.items()}
        return {"name": path.name, "bytes": len(payload), "crc32": zlib.crc32(payload), "words": words}


@dataclass(frozen=True)
class Labels:
    """The labels of a split.

    Attributes:
        words: the words of each column, in the order of their first use.
        codes: the index of each record's word among its column's words, (N,).
    """

    words: dict[str, list[str]]
    codes: dict[str, Int32[np.ndarray, " N"]]

    @classmethod
    def read(cls, path: Path, entry: dict[str, Any]) -> "Labels":
        """Inverts :meth:`LabelWriter.write`.

        Raises:
            OSError: the file cannot be read.
            ValueError: the file is damaged.
        """
        payload = regular(path).read_bytes()
        if zlib.crc32(payload) != entry["crc32"]:
            raise ValueError("its checksum is wrong")
        codes = np.load(io.BytesIO(payload), allow_pickle=False)
        if any(len(words) <= max(column) for words, column in zip(entry["words"].values(), codes, strict=True)):
            raise ValueError("the manifest lacks words of it")
        return cls(entry["words"], dict(zip(entry["words"], codes, strict=True)))

    def of(self, number: int) -> Words:
        """Returns the labels of one record."""
        return {name: words[self.codes[name][number]] for name, words in self.words.items()}

    def matching(self, patterns: Mapping[str, tuple[str, ...]]) -> Bool[np.ndarray, " N"]:
        """Returns which records match: in each named column, one of the shell patterns matches the record's word."""
        passes = np.ones(len(next(iter(self.codes.values()))), bool)
        for name, allowed in patterns.items():
            chosen = [any(fnmatch.fnmatchcase(word, pattern) for pattern in allowed) for word in self.words[name]]
            passes &= np.asarray(chosen, bool)[self.codes[name]]
        return passes

    def counts(self) -> dict[str, dict[str, int]]:
        """Returns the number of records with each word of each column."""
        return {
            name: dict(zip(words, np.bincount(self.codes[name], minlength=len(words)).tolist(), strict=True))
            for name, words in self.words.items()
        }
