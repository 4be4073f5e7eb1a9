"""The command line: one module per command, which reads arguments and prints results.

Words, tables and exit codes live here; every figure comes from the packages below.
Nothing outside this folder imports it, and no physics or file format is defined here.
"""
