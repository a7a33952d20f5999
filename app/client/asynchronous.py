"""The client that awaits, which is `magcal_client`'s."""

from magcal_client.asynchronous import AsyncClient

__all__ = ["AsyncClient"]
