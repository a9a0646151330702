"""How near the maps are to a known truth: suites of measured tables and figures."""
