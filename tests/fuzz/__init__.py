"""Seeded malformed and odd inputs: each ends in one clear error or in a correct run.

An area is a function of a ``Scratch``, which has the random numbers of a case and its folder. It
makes an input and uses it: an ``SdcError`` counts as a clean error, a return as a correct run, and
all else is a failure. ``python -m tests.fuzz --help`` says how to run them.
"""
