"""Publish the points of a simulated lidar ten times per second, as a ROS 2 node.

The node subscribes to the sensor pose on the topic `pose`. It publishes the points on the topic
`points`, in the sensor frame and with the fields of the Velodyne driver:

    python ros2_scanner.py --ros-args -p scene:=hall.glb -p sensor:=velodyne/vlp16
"""

from array import array

import numpy as np

from lidarpool import Pose, Scanner, Scene, load_sensor
from lidarsim.motion.rotations import matrices

FRAME = "lidar"
RATE_HZ = 10
STEP = 22  # bytes per point
# Name, NumPy type, ROS type, and offset within the 22 bytes of a point.
FIELDS = (
    ("x", "<f4", 7, 0),
    ("y", "<f4", 7, 4),
    ("z", "<f4", 7, 8),
    ("intensity", "<f4", 7, 12),
    ("ring", "<u2", 4, 16),
    ("time", "<f4", 7, 18),
)


def scanner_of(scene, model):
    columns = ["intensity", "time"]
    return Scanner(scene, load_sensor(model), columns=columns, coordinates="sensor")


def message_of(cloud, begin_ns, header, kinds):
    """Convert a sweep to a PointCloud2 message.

    `kinds` is the module sensor_msgs.msg.
    """
    names, types, _, offsets = zip(*FIELDS, strict=True)
    row = {"names": names, "formats": types, "offsets": offsets, "itemsize": STEP}
    points = np.zeros(len(cloud), np.dtype(row))
    for axis, values in zip("xyz", cloud.positions.T, strict=True):
        points[axis] = values
    points["intensity"] = cloud.intensity
    points["ring"] = cloud.channel
    points["time"] = (cloud.time - begin_ns) / 1e9
    fields = [
        kinds.PointField(name=name, offset=offset, datatype=kind, count=1)
        for name, _, kind, offset in FIELDS
    ]
    return kinds.PointCloud2(
        header=header, height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=STEP, row_step=STEP * len(points), data=array("B", points.tobytes()),
        is_dense=True,
    )  # fmt: skip


def main():
    import rclpy
    import sensor_msgs.msg
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from std_msgs.msg import Header

    class ScannerNode(Node):
        def __init__(self):
            super().__init__("lidarpool_scanner")
            path = self.declare_parameter("scene", "").value
            model = self.declare_parameter("sensor", "velodyne/vlp16").value
            self.scanner = scanner_of(Scene.load(path) if path else Scene.seed(), model)
            self.pose = Pose((0, 0, 1))
            self.number = 0
            kind = sensor_msgs.msg.PointCloud2
            profile = qos_profile_sensor_data
            self.publisher = self.create_publisher(kind, "points", profile)
            self.create_subscription(PoseStamped, "pose", self.on_pose, 1)
            self.create_timer(1 / RATE_HZ, self.on_timer)

        def on_pose(self, message):
            position = message.pose.position
            orientation = message.pose.orientation
            [rotation] = matrices(
                np.array([[orientation.x, orientation.y, orientation.z, orientation.w]])
            )
            self.pose = Pose.from_rotation([position.x, position.y, position.z], rotation)

        def on_timer(self):
            header = Header(stamp=self.get_clock().now().to_msg(), frame_id=FRAME)
            cloud = self.scanner.sweep(self.pose, number=self.number, start_s=0)
            self.publisher.publish(message_of(cloud, 0, header, sensor_msgs.msg))
            self.number += 1

    rclpy.init()
    rclpy.spin(ScannerNode())


if __name__ == "__main__":
    main()
