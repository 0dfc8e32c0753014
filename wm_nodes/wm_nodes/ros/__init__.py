"""What knows rclpy but no algorithm: QoS, conversion, parameters, lifecycle, spinning, sequence numbers, credit.

This package imports rclpy and wm_msgs; the core of wm_nodes never imports it.
"""
