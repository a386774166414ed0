"""Sources: rasters and terrain models that lie behind a URL instead of on this machine.

GDAL reads them by windows with range requests, under names of its own: `https://…` is `/vsicurl/https://…`, `s3://…` is
`/vsis3/…`, and so on. Credentials, endpoints and regions are GDAL's environment variables (`AWS_PROFILE`,
`AWS_NO_SIGN_REQUEST`, `AWS_S3_ENDPOINT` …). A name that stands for a file is left as it is.
"""

from __future__ import annotations

import re
from pathlib import Path

from kibs_steps import fingerprint
from kibs_steps.errors import KibsError

SCHEMES = {
    "s3": "/vsis3/",
    "gs": "/vsigs/",
    "az": "/vsiaz/",
    "azure": "/vsiaz/",
    "oss": "/vsioss/",
    "swift": "/vsiswift/",
}
PATIENCE = 30.0  # s to wait for a server's answer

# One request finds a header, no listing of the folder beside it; what is read once is kept for the neighbouring window.
GDAL = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_HTTP_MAX_RETRY": "5",
    "GDAL_HTTP_RETRY_DELAY": "1",
    "GDAL_HTTP_MERGE_CONSECUTIVE_RANGES": "YES",
    "GDAL_INGESTED_BYTES_AT_OPEN": "32768",
    "VSI_CACHE": "TRUE",
}


class SourceUnreachable(KibsError):
    """A URL that does not answer."""


def place(name: str) -> str:
    """GDAL's name of a file, a URL or a bucket's object."""
    found = re.fullmatch(r"([a-z0-9]+)://(.+)", name)
    if not found:
        return name
    scheme, rest = found.groups()
    return f"/vsicurl/{name}" if scheme in ("http", "https") else SCHEMES.get(scheme, f"{scheme}://") + rest


def is_remote(path: str) -> bool:
    """Whether a path, as `place` gives it, lies outside this machine's file system."""
    return path.startswith("/vsi") or "://" in path


def version(path: str) -> list[str | None]:
    """What tells that a remote source was changed: entity tag, date and length, if it has an HTTP URL; else its name alone.

    Raises `SourceUnreachable`.
    """
    if not path.startswith("/vsicurl/"):
        return [path]
    import urllib.error
    import urllib.request

    url = path.removeprefix("/vsicurl/")
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=PATIENCE) as answer:
            return [path, *(answer.headers.get(name) for name in ("ETag", "Last-Modified", "Content-Length"))]
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise SourceUnreachable(f"{url} does not answer ({error}): check the URL and the network") from error


def content(path: str, cache: str | Path) -> str | list[str | None]:
    """What a signature holds of a source: the content's hash of a file (of several, if it names others), `version` of a URL, the
    name of what is missing."""
    if is_remote(path):
        return version(path)
    return fingerprint.of_source(path, cache) if Path(path).exists() else path


def files(*paths: str) -> list[str]:
    """Those of the paths that are files of this machine, for a workflow to depend on."""
    return [path for path in paths if not is_remote(path)]
