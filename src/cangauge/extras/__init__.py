"""What has a dependency or a user of its own; the core imports none of it but by name."""
