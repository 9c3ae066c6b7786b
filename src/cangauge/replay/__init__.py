"""Log or capture → frames on a bus, in time."""
