"""Find current, voltage, SoC and temperature in frames without a DBC, by physics."""
