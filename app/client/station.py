"""A ground station's folder, which is `magcal_client`'s."""

from magcal_client.errors import StoppedError
from magcal_client.station import Destination, Outcome, Station

__all__ = ["Destination", "Outcome", "Station", "StoppedError"]
