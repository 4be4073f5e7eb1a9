"""Command line: one module per command, which parses arguments and prints results.

This package defines texts, tables and exit codes, and no physics or file formats; other packages
compute all figures. No other package imports it.
"""
