# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0

# Read by `make setup` alone, when it builds valveflow_msgs: the generated sources of
# these libraries are compiled as one file each, and nothing is optimised. That takes
# about half the processor time. (The other generated sources cannot be joined: they
# repeat names.) A colcon build on a ROS installation does not see this file.
if(NOT PROJECT_NAME STREQUAL "valveflow_msgs")
  return()
endif()

function(join_sources)
  foreach(kind fastrtps_c fastrtps_cpp introspection_c c cpp)
    set_target_properties(${PROJECT_NAME}__rosidl_typesupport_${kind}
      PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
  endforeach()
endfunction()

# The libraries exist only at the end of the project's own file.
cmake_language(DEFER CALL join_sources)
