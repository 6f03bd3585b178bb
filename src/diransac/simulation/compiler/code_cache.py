"""Machine code on disk: a process compiles nothing that an earlier one has compiled.

An entry is a file that is named by its key, the hash of all that determines the code. It holds the key and a checksum
of the code, so that a file that is damaged, cut short or renamed is no entry. The checksum is no signature: whoever can
write to the folder can run code as the user. A folder is therefore used only if it belongs to the user and is writable
to nobody else. Where reading or writing fails, code is compiled as without a cache.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from diransac.atomic import write_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable


@dataclass(frozen=True)
class CodeCache:
    """Folder of machine code.

    Parameters
    ----------
    folder : Path
        Made when something is first written, for the user alone.
    size_limit : int
        Bytes of all entries; beyond it those are removed that were used the longest ago, at one of sixteen writes.
    """

    folder: Path
    # Bytes of all entries of a folder; a module has 20 kB to 5 MB.
    size_limit: int = 256 * 2**20

    @staticmethod
    def of_user() -> CodeCache | None:
        """Cache in the folder `DIRANSAC_CACHE`, else in the user's cache directory; None if that is `off`."""
        asked = os.environ.get("DIRANSAC_CACHE", "")
        if asked == "off":
            return None
        try:
            return CodeCache(Path(asked).expanduser().absolute() if asked else _user_folder())
        except RuntimeError:  # no home directory
            return None

    def read(self, key: str) -> bytes | None:
        """Machine code of a key; None where there is no sound entry."""
        head = _head(key)
        try:
            if self.objection():
                return None
            content = self._path(key).read_bytes()
        except OSError:
            return None
        code = content[len(head) + hashlib.sha256().digest_size :]
        if content != head + hashlib.sha256(code).digest() + code:
            return None
        with suppress(OSError):  # of another user's mount, or read-only
            os.utime(self._path(key))
        return code

    def write(self, key: str, code: bytes) -> None:
        """Keep machine code, and remove the oldest entries beyond the limit; nothing happens where that fails."""
        content = _head(key) + hashlib.sha256(code).digest() + code
        with suppress(OSError):
            self.folder.mkdir(0o700, parents=True, exist_ok=True)
            if not self.objection():
                write_bytes(self._path(key), content, mode=0o600)
                if key.startswith("0"):  # one key of sixteen: looking at all entries takes longer than writing one
                    self._trim()

    def objection(self) -> str:
        """Reason for not using the folder; empty if there is none."""
        try:
            found = self.folder.stat()
        except FileNotFoundError:
            return ""
        except OSError as error:
            return error.strerror or str(error)
        if not stat.S_ISDIR(found.st_mode):
            return "it is not a folder"
        if hasattr(os, "geteuid"):  # elsewhere, folders within a user's profile are private
            if found.st_uid != os.geteuid():
                return "it belongs to another user"
            if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return "other users can write to it"
        return ""

    def sizes(self) -> dict[Path, int]:
        """Bytes of each entry, the one used the longest ago first."""
        found = []
        for path in self.folder.glob("*.code"):
            with suppress(FileNotFoundError):  # another process has removed it meanwhile
                found.append((path, path.stat()))
        return {path: entry.st_size for path, entry in sorted(found, key=lambda one: one[1].st_mtime)}

    def clear(self) -> None:
        """Remove all entries.

        Raises OSError: an entry cannot be removed.
        """
        for path in self.sizes():
            path.unlink(missing_ok=True)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.code"

    def _trim(self) -> None:
        """Remove the oldest entries beyond the limit."""
        sizes = self.sizes()
        excess = sum(sizes.values()) - self.size_limit
        for path, size in sizes.items():
            if excess <= 0:
                break
            path.unlink(missing_ok=True)
            excess -= size


def hashed(parts: Iterable[str]) -> str:
    """SHA-256 of a list of texts, in hexadecimal digits; each text's length counts, too."""
    digest = hashlib.sha256()
    for part in parts:
        encoded = part.encode()
        digest.update(f"{len(encoded)} ".encode() + encoded)
    return digest.hexdigest()


def _head(key: str) -> bytes:
    """First bytes of an entry."""
    return b"diransac machine code 1\n" + key.encode() + b"\n"


def _user_folder() -> Path:
    """Folder for machine code in the user's cache directory.

    Raises RuntimeError: the user has no home directory.
    """
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "diransac" / "code"
