"""The service on a CAN bus, and the same pipeline over recordings."""
