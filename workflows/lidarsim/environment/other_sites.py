"""Protect HTTP services against cross-site requests and DNS rebinding.

With an image, a form or a script, any website can make a visitor's browser send requests to
services on the visitor's machine and network. Browsers prevent the website from reading the
responses, but they do not prevent the requests. If the website resolves one of its names to an
address of the visitor (DNS rebinding), it can even read the responses, because the browser treats
the service as part of the website.

Browsers identify the origin of a request in headers that scripts cannot change: `Sec-Fetch-Site`
(W3C Fetch Metadata), `Origin` (RFC 6454), `Host` and `Referer` (RFC 9110). Other programs usually
send only `Host`.

The packages lidarsim and poolpart can be installed separately, so each contains a copy of this
module. A test checks that both files are identical.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Collection, Mapping
from ipaddress import ip_address
from urllib.parse import urlsplit

# HOST[:PORT], where IPv6 addresses are enclosed in brackets.
_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[^\s:/?#@\[\],]+)(?::\d*)?", re.ASCII | re.IGNORECASE)
_OWN_SITES = ("none", "same-origin")  # "none" if the user has typed the address
_BROWSER = "mozilla/"  # every browser's User-Agent begins with this


def names_of_machine(listens_at: str) -> frozenset[str]:
    """Return the host names by which clients may address a service.

    If the service listens on a network, the names include the fully qualified domain name of the
    machine, whose lookup may take seconds.
    """
    hostname = socket.gethostname().lower()
    names = {"localhost", hostname, f"{hostname}.local"}
    if not _is_loopback(listens_at):
        names.add(socket.getfqdn().lower())
    return frozenset(names)


def refusal(
    headers: Mapping[str, str],
    names: Collection[str] | None,
    *,
    url_authority: str = "",
    changes_state: bool = False,
    is_page: bool = False,
) -> str:
    """Return why a cross-site request is rejected, or "" if the request is accepted.

    Parameters
    ----------
    headers
        Mapping of names in lower case to values. The values of a repeated header are joined by
        commas.
    names
        Names of the service in lower case, or None if it is behind a proxy whose name is unknown.
        Numeric addresses are always accepted, because a browser that requests a numeric address
        has connected to it.
    url_authority
        HOST[:PORT] of an absolute URL in the request line, as sent by clients of a proxy.
    changes_state
        Whether the request changes the state of the service. Browsers send `Sec-Fetch-Site` only
        over TLS and to the loopback interface, and they do not send `Origin` with requests for
        images. Therefore, if a browser sends neither header, `Referer` must refer to the service.
    is_page
        Whether the response is a read-only page that other websites may link to.
    """
    authorities = [text for text in (headers.get("host"), url_authority) if text]
    for authority in authorities:
        host = _host_of(authority)
        if host is None or not (names is None or _is_address(host) or host in names):
            return f"{authority[:100]!r} is not a name of this server. Use its address."
    site = headers.get("sec-fetch-site")
    follows_link = is_page and headers.get("sec-fetch-mode") == "navigate"
    if site is not None and site not in _OWN_SITES and not follows_link:
        return "Requests from other websites are rejected."
    origin = headers.get("origin")
    if origin is not None and not _is_of(origin, authorities):
        return "Requests from other websites are rejected."
    is_browser = headers.get("user-agent", "").lower().startswith(_BROWSER)
    says_nothing = is_browser and site is None and origin is None
    if changes_state and says_nothing and not _is_of(headers.get("referer", ""), authorities):
        return "Requests that change data must come from the same origin."
    return ""


def _host_of(authority: str) -> str | None:
    """Return the host in HOST[:PORT] in lower case, or None if the text has another form."""
    match = _AUTHORITY.fullmatch(authority)
    return match[1].lower().removesuffix(".") if match else None


def _is_of(url: str, authorities: Collection[str]) -> bool:
    """Return whether a URL has one of the hosts and ports to which a request is addressed."""
    try:
        return urlsplit(url).netloc.lower() in [authority.lower() for authority in authorities]
    except ValueError:
        return False


def _is_address(host: str) -> bool:
    """Return whether a host is a numeric IPv4 or IPv6 address."""
    try:
        ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    """Return whether a host is "localhost" or a numeric loopback address."""
    return host == "localhost" or (_is_address(host) and ip_address(host.strip("[]")).is_loopback)
