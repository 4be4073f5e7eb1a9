"""Pictures, HTML reports and Rerun recordings of results.

Everything here reads what the simulator or a run folder holds, and draws it.
Nothing here computes physics, and the simulator never imports it.
"""
