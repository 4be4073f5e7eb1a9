"""Pictures and recordings of results; never imported by the simulator."""
