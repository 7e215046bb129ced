"""One member of a zip archive."""

import os
import zipfile
import zlib

from prism_jax.io.errors import InputError


def read_member(path: str | os.PathLike, name: str, max_bytes: int) -> bytes:
    """All bytes of one member of a zip archive.

    Nothing is unpacked to disk. The archive's claim of the member's size is compared
    with `max_bytes` before it is read, and no more than is claimed is decompressed. An
    archive or a member that is missing, damaged, too large, encrypted or empty raises
    an InputError.
    """
    subject, remedy = f"{os.fspath(path)}: {name}", "restore the archive"
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(name)
            if not 0 < member.file_size <= max_bytes:
                size = f"{member.file_size:,} bytes"
                fault = f"size {size} is not within 1 to {max_bytes:,}"
                raise InputError(subject, fault, remedy)
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(subject, "compression is not supported", remedy)
            return archive.read(member)
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except KeyError:
        raise InputError(subject, "not in the archive", remedy) from None
    except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        fault = f"cannot be read ({error})"
        raise InputError(subject, fault, remedy) from None
