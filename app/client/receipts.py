"""A station's receipts, which are `magcal_client`'s."""

from magcal_client.receipts import Receipt, append_receipt, read_receipts

__all__ = ["Receipt", "append_receipt", "read_receipts"]
