"""Download of weather and carbon intensity from public services, as files for ``data import``.

``services.yaml`` describes the services. ``download`` sends HTTP requests and stores each answer
with its origin. ``weather`` and ``generation`` convert answers to tables, and ``saved_tables``
converts tables that a user saved by hand. ``fetching`` combines these steps. Simulations do not use
this package.
"""
