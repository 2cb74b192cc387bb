"""What operating systems and editors leave in folders: it is passed over wherever one is read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path, PurePath

# Names of files and folders, in lower case; what lies in such a folder is left over too.
LEFTOVERS = (
    # macOS, also on other systems' disks and in archives
    *(".ds_store", "._*", "__macosx", ".spotlight-v100", ".trashes", ".fseventsd", ".appledouble", "icon\r"),
    # Windows
    *("thumbs.db", "thumbs.db:encryptable", "ehthumbs.db", "desktop.ini", "$recycle.bin", "system volume information"),
    # Linux: file managers, network file systems, disk checks
    *(".directory", ".trash-*", ".nfs*", ".fuse_hidden*", "lost+found"),
    # NAS, synchronisation, notebooks, editors
    *("@eadir", ".syncthing.*", ".dropbox", ".~lock.*", ".ipynb_checkpoints", ".*.swp", "*~"),
)


def is_leftover(path: PurePath, root: PurePath | None = None) -> bool:
    """Whether a file or folder is left over, or lies in a folder that is.

    Args:
        path: What is asked about.
        root: Folder that is being read: names above it do not count. Without it only the last name does.

    Example:
        >>> from pathlib import Path
        >>> from surgbench.leftovers import is_leftover
        >>> is_leftover(Path("masks/._000000.png")), is_leftover(Path("masks/000000.png"))
        (True, False)
    """
    parts = (path.name,) if root is None else path.relative_to(root).parts
    return any(fnmatchcase(part.lower(), pattern) for part in parts for pattern in LEFTOVERS)


def without_leftovers(paths: Iterable[Path], root: Path | None = None) -> Iterator[Path]:
    """Paths that are not left over; see :func:`is_leftover`."""
    return (path for path in paths if not is_leftover(path, root))
