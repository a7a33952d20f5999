"""`magcal push`: the station's command, which is `magcal_client`'s."""

from magcal_client.push import command, shown

__all__ = ["command", "shown"]
