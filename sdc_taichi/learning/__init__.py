"""Learning: the algorithms of the paper, their training, and the policies that come out of it.

An algorithm acts in a stream of environments, learns from it, and hands out networks.
A policy is a set of networks with a description of the environment that it fits, and a controller.
PyTorch is needed to train, and not to run a policy.
"""
