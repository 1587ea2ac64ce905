"""Requests that a website makes with the browser of its visitor, which our services refuse.

Any website can let a visitor's browser send requests to services of the visitor's machine and
network, by an image, a form or a script. Browsers keep the website from reading the answers. They
do not keep the requests from being sent, and a name that the website resolves to an address of the
visitor (DNS rebinding) makes the service a part of the website.

Browsers say in headers that no script can change who asks: `Sec-Fetch-Site` (W3C Fetch Metadata),
`Origin` (RFC 6454), `Host` and `Referer` (RFC 9110). Other programs send none of them but `Host`.

The packages lidarsim and poolpart can be installed alone, so each has this module. A test holds
both files equal.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Collection, Mapping
from ipaddress import ip_address
from urllib.parse import urlsplit

# HOST[:PORT]; an address of IPv6 stands in brackets.
_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[^\s:/?#@\[\],]+)(?::\d*)?", re.ASCII | re.IGNORECASE)
_OWN_SITES = ("none", "same-origin")  # "none" is of an address that the user has typed
_BROWSER = "mozilla/"  # first letters of the User-Agent of every browser


def names_of_machine(listens_at: str) -> frozenset[str]:
    """Return the names that clients may use for a service that listens at an address.

    The domain of the machine, whose look-up may take seconds, counts where the service listens on
    a network.
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
    """Return why a request comes from another site, for the client, or "" if it is answered.

    Parameters
    ----------
    headers
        {name in lower case: value}; values of a repeated header are joined by commas.
    names
        Names of the service in lower case, or None where a proxy of an unknown name is in use. A
        numeric address does not count as a name: a browser that asks for an address has connected
        to it.
    url_authority
        HOST[:PORT] of a URL in absolute form, as clients of a proxy send it.
    changes_state
        Whether the request changes the state of the service. Browsers send `Sec-Fetch-Site` only
        over TLS and to the loopback interface, and no `Origin` for an image. So a browser that
        sends neither needs a `Referer` of the service.
    is_page
        Whether the answer is a document that changes nothing and may be the target of links.
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
    """Return the host of HOST[:PORT] in lower case, or None for other text."""
    match = _AUTHORITY.fullmatch(authority)
    return match[1].lower().removesuffix(".") if match else None


def _is_of(url: str, authorities: Collection[str]) -> bool:
    """Return True if a URL is of the host and port that a request asks for."""
    try:
        return urlsplit(url).netloc.lower() in [authority.lower() for authority in authorities]
    except ValueError:
        return False


def _is_address(host: str) -> bool:
    """Return True for an address of IPv4 or IPv6 as numbers."""
    try:
        ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    """Return True for an address of the loopback interface, as numbers, and for localhost."""
    return host == "localhost" or (_is_address(host) and ip_address(host.strip("[]")).is_loopback)
