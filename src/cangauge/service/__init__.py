"""The service that runs on a bus: configuration and loop."""
