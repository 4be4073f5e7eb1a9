"""Weather and carbon intensity from public services, as files that ``data import`` reads.

``services.yaml`` holds what is known of each service. ``download`` speaks HTTP and keeps each
answer with its origin; ``weather`` and ``generation`` turn answers into tables, ``saved_tables``
does so with tables that a user saved by hand; ``fetching`` joins them. No simulation uses this.
"""
