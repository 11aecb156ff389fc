"""A graph network that synchronises relative transforms (Yew and Lee, 3DV 2021).

The paper of the NSS dataset calls it PoseGraphNet; its authors' code is
https://github.com/yewzijian/MultiReg, of the paper "Learning Iterative Robust Transformation
Synchronization" (arXiv:2111.00728).
"""
