"""The dashboard: pages at the addresses of what they show, over the public API."""
