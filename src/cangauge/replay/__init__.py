"""Replay of logs and captures as frames on a bus."""
