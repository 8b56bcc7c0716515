"""A ROS 2 bridge: a session on one side, topics on the other.

``real2sim ros2`` runs it. :mod:`.messages` makes messages of observations, :mod:`.commands` makes
plans of messages; both know ROS by the names of its message types alone. :mod:`.bridge` is the loop
and :mod:`.node` the only module that needs ``rclpy``.
"""
