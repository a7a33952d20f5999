"""How connectors ask: one host that the settings name, no redirects, no proxies, a bounded answer, 200 or nothing."""

from __future__ import annotations

from collections.abc import Mapping


class SourceClient:
    """Asks the one host of ``base_url``; requests to any other are refused."""

    def __init__(self, base_url: str, headers: Mapping[str, str] | None = None) -> None:
        from app.connectors.one_host import client_of

        self._http = client_of(base_url, headers)

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def get(self, url: str, params: Mapping[str, str] | None = None) -> bytes:
        """Return the body of the answer 200 to a GET; raises `app.connectors.errors`."""
        return self._http.get(url, params=dict(params) if params else None).content
