"""Definitions of the stock messages that are written and read where no ROS is installed.

Fields stand as ROS 2 Jazzy defines them (the type hashes agree); comments are our own.
"""

BUNDLED: dict[str, str] = {
    'builtin_interfaces/msg/Time': """\
int32 sec       # [s] since the Unix epoch
uint32 nanosec  # [ns] added to the seconds, below 1e9
""",
    'builtin_interfaces/msg/Duration': """\
int32 sec       # [s]
uint32 nanosec  # [ns] added to the seconds, below 1e9
""",
    'std_msgs/msg/Header': """\
builtin_interfaces/Time stamp  # time of the data
string frame_id                # what the data belong to
""",
    'std_msgs/msg/Float64': 'float64 data\n',
    'std_msgs/msg/Bool': 'bool data\n',
    'std_msgs/msg/String': 'string data\n',
    'std_msgs/msg/MultiArrayDimension': """\
string label   # name of the dimension
uint32 size    # elements along it
uint32 stride  # elements from here inwards
""",
    'std_msgs/msg/MultiArrayLayout': """\
MultiArrayDimension[] dim  # outermost first
uint32 data_offset         # elements to skip at the front
""",
    'std_msgs/msg/Float64MultiArray': """\
MultiArrayLayout layout
float64[] data
""",
    'rosgraph_msgs/msg/Clock': 'builtin_interfaces/Time clock\n',
    'diagnostic_msgs/msg/KeyValue': """\
string key
string value
""",
    'diagnostic_msgs/msg/DiagnosticStatus': """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3

byte level          # one of the above
string name         # node and component
string message      # for a person
string hardware_id  # the device
KeyValue[] values
""",
    'diagnostic_msgs/msg/DiagnosticArray': """\
std_msgs/Header header
DiagnosticStatus[] status
""",
}
