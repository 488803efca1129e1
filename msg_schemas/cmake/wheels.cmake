# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
#
# What an interface package needs where ROS 2 comes from wheels; it changes nothing elsewhere.

# Find ament_cmake, and let the packages beside it be found.
macro(find_ament)
  # Inside pip only the wheels of the build count, even where a ROS installation is sourced.
  if(DEFINED SKBUILD)
    set(ENV{CMAKE_PREFIX_PATH} "")
    set(ENV{AMENT_PREFIX_PATH} "")
  endif()
  find_package(ament_cmake REQUIRED)
  # Sourcing a ROS installation puts its prefix into AMENT_PREFIX_PATH; the wheels do not do that.
  cmake_path(CONVERT "$ENV{AMENT_PREFIX_PATH}" TO_CMAKE_PATH_LIST _prefixes NORMALIZE)
  cmake_path(SET _prefix NORMALIZE "${ament_cmake_DIR}/../../..")
  string(REGEX REPLACE "/$" "" _prefix "${_prefix}")
  list(APPEND _prefixes "${_prefix}")
  list(REMOVE_DUPLICATES _prefixes)
  cmake_path(CONVERT "${_prefixes}" TO_NATIVE_PATH_LIST _prefixes)
  set(ENV{AMENT_PREFIX_PATH} "${_prefixes}")
endmacro()

# The wheels name Python and NumPy headers of the machine that built them. CMake refuses an
# imported target with a folder that does not exist; our own headers are found without them.
function(drop_headers_of_the_build_machine)
  get_property(_imported DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _imported)
    get_target_property(_dirs ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_target MATCHES "__rosidl_generator_py$" AND _dirs)
      list(FILTER _dirs EXCLUDE REGEX "^/opt/python/")
      set_target_properties(${_target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${_dirs}")
    endif()
  endforeach()
endfunction()
