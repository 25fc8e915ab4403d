"""The live service: robots send samples over a WebSocket and get terrain, target slips and commands."""
