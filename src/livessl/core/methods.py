"""Names of the localization methods (`onset`, `srp-phat`, … or `MODULE:NAME`), and the error for an unknown one.

Their code is registered in `core/locate/estimator.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from typing import Final

ONSET: Final = "onset"
SRP_PHAT: Final = "srp-phat"
CEPSTRAL: Final = "cepstral"
AVERAGED: Final = "averaged"

METHODS: Final[dict[str, str | Callable[..., object]]] = {
    ONSET: "livessl.core.locate.onset:Onset",
    SRP_PHAT: "livessl.core.locate.srp_phat:SrpPhat",
    CEPSTRAL: "livessl.core.locate.srp_phat:Cepstral",
    AVERAGED: "livessl.core.locate.srp_phat:Averaged",
}
"""Registry of the methods: from the name in a site file or on the command line to the factory of its estimator.

A factory is a callable, or the text "module:attribute" of one that is imported when it is first needed. Use
`livessl.core.locate.estimator.register` to add a method and `create` to make an estimator."""


def is_import_path(name: str) -> bool:
    """Return whether a name has the form `MODULE:NAME`, such as `my_methods:Loudest`; nothing is imported."""
    module, colon, attribute = name.partition(":")
    return bool(colon) and all(part.isidentifier() for part in (*module.split("."), *attribute.split(".")))


def is_method(name: str) -> bool:
    """Return whether a name may be that of a method: it is registered, or has the form `MODULE:NAME`."""
    return name in METHODS or is_import_path(name)


def unknown_method(name: str) -> str:
    """Return the error text for a name that is no method, with the nearest registered name."""
    close = get_close_matches(name, METHODS, n=1)
    cure = f"did you mean {close[0]!r}?" if close else "write a method of your own as MODULE:NAME"
    return f"expected one of {', '.join(METHODS)}, got {name!r}; {cure}"
