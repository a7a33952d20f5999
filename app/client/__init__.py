"""The Python client: `Client` blocks, `AsyncClient` awaits."""

from app.client.asynchronous import AsyncClient as AsyncClient
from app.client.blocking import Client as Client
