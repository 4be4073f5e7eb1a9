"""Weather and carbon intensity from public services, as files that ``data import`` reads.

Each service has a module that makes its requests and turns its answers into an EPW file or a carbon
table. ``download`` alone speaks HTTP, and ``kept_downloads`` keeps what was downloaded with its
origin, so that nothing is downloaded twice. Nothing here is used by a simulation, and the library
for HTTP is loaded by a download alone.
"""
