"""A ROS 2 bridge: a session on one side, topics on the other.

``real2sim ros2`` runs it. :mod:`.messages` converts observations to messages, :mod:`.commands`
converts messages to plans; both only use the names of ROS message types. :mod:`.bridge` is the
loop, and :mod:`.node` is the only module that requires ``rclpy``.
"""
