"""Refuses web requests that do not come from the viewer's own page.

Any web page that a browser shows may open connections to a server on the same machine.
Two headers of a request tell whether it comes from the viewer's own page. ``Origin``
names the page that opened the connection. ``Host`` is the name by which the page knows
the server. If another site makes its own domain name resolve to this machine (DNS
rebinding), ``Host`` is that name.
"""

import contextlib
import http
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers, MultipleValuesError
from websockets.http11 import Request, Response

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
# Addresses that stand for all addresses of the machine, so they are not names of it.
WILDCARDS = ("0.0.0.0", "::", "")

_PATCH_LOCK = threading.Lock()


def allowed_names(address: str, listed: Sequence[str]) -> frozenset[str]:
    """Names under which browsers may reach a server.

    They are the loopback names, the server's address and further listed names.

    Args:
        address: Address at which the server listens.
        listed: Further names.
    """
    own_name = () if address in WILDCARDS else (address,)
    return frozenset(x.lower() for x in (*LOOPBACK_NAMES, *own_name, *listed))


def reason_to_refuse(headers: Headers, names: frozenset[str]) -> str | None:
    """Why a request is refused; None if it is allowed.

    Args:
        headers: Headers of the request.
        names: Names, without ports, that its ``Host`` may have.
    """
    try:
        host, origin = headers.get("Host", "").lower(), headers.get("Origin")
    except MultipleValuesError:
        return "the request has two Host or two Origin headers"
    # A name or an address, in brackets if it is an IPv6 address. Accept any port,
    # because a tunnel may have changed it.
    match = re.fullmatch(r"(?:\[([^\]@]+)\]|([^\[\]@:/]+))(?::\d+)?", host)
    name = None if match is None else match[1] or match[2]
    if name not in names:
        return (
            f"the viewer is not served under the name {name!r}: open it as localhost, "
            f"or list the name in open_viewer(allowed_hosts=...)"
        )
    if origin is not None and urlsplit(origin).netloc.lower() != host:
        return f"the request comes from another page, {origin!r}"
    return None


@contextlib.contextmanager
def restricted_servers(names: frozenset[str]) -> Iterator[None]:
    """Context manager in which a new viser server checks every request.

    viser has no setting for such a check, but it starts its server by calling
    `websockets.asyncio.server.serve`. This context manager replaces that function by
    one that adds the check.

    Raises:
        RuntimeError: viser did not start a server through that function, so requests
            would not be checked.
    """
    serve = websockets.asyncio.server.serve
    checked = []

    @wraps(serve)
    def serve_checked(handler: Any, *args: Any, **options: Any) -> Any:  # noqa: ANN401
        if getattr(handler, "__module__", "").startswith("viser."):
            options["process_request"] = _check_first(
                names, options.get("process_request")
            )
            checked.append(handler)
        return serve(handler, *args, **options)

    with _PATCH_LOCK:
        websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not checked:
        raise RuntimeError(
            "the viewer cannot check web requests with this version of viser: install "
            "the version that pyproject.toml lists"
        )


def _check_first(
    names: frozenset[str], process_request: Callable[..., Any] | None
) -> Callable[..., Any]:
    """Wrap ``process_request`` so that it is called for allowed requests only."""

    def process(connection: Any, request: Request) -> Any:  # noqa: ANN401 (websockets')
        reason = reason_to_refuse(request.headers, names)
        if reason is None:
            if process_request is None:
                return None
            return process_request(connection, request)
        body = f"{reason}\n".encode()
        headers = Headers(
            {"Content-Type": "text/plain", "Content-Length": str(len(body))}
        )
        status = http.HTTPStatus.FORBIDDEN
        return Response(status.value, status.phrase, headers, body)

    return process
