"""Refuses web requests that do not come from the viewer's own page.

Any web page that a browser shows may open connections to servers on the same machine.
Browsers name that page in the header ``Origin``. A page whose name is made to resolve
to this machine (DNS rebinding) gives itself away by the header ``Host``.
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
WILDCARDS = ("0.0.0.0", "::", "")  # addresses that name no machine

_patching = threading.Lock()


def allowed_names(address: str, listed: Sequence[str]) -> frozenset[str]:
    """Names under which a server may be called: loopback, its own and listed ones.

    Args:
        address: Address at which it serves.
        listed: Further names.
    """
    own = () if address in WILDCARDS else (address,)
    return frozenset(x.lower() for x in (*LOOPBACK_NAMES, *own, *listed))


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
    # A name or address, in brackets if it is of IPv6, and any port: tunnels change it.
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
    """Let the viser server that is made in this context check every request.

    viser has no setting for it. It calls `websockets.asyncio.server.serve`, to which
    this adds the check.

    Raises:
        RuntimeError: no server was made through this function, so that its requests
            would go unchecked.
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

    with _patching:
        websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not checked:
        raise RuntimeError("this version of viser does not allow to check its requests")


def _check_first(
    names: frozenset[str], process_request: Callable[..., Any] | None
) -> Callable[..., Any]:
    """A function that processes requests only if they are allowed."""

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
