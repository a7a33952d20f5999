"""A ground station's folder, which is `magcal_client`'s."""

from magcal_client.station import Destination, Outcome, Station, taken

__all__ = ["Destination", "Outcome", "Station", "taken"]
