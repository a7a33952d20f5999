"""`magcal push`: the station's command, which is `magcal_client`'s."""

from magcal_client.push import command

__all__ = ["command"]
