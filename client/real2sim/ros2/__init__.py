"""A ROS 2 bridge: a session on one side, topics on the other.

``real2sim ros2`` runs it. :mod:`.messages` converts observations to ROS messages and
messages to plans; it does not import ROS. :mod:`.bridge` runs the loop, and its node is the only
part that requires ``rclpy``.
"""
