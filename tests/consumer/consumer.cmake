# The program that every way of using lvggt has to build. The two files include the same headers under
# different optimisation, and nothing of lvggt's own build may reach them.
foreach(target lvggt::lvggt lvggt::kernels)
  get_target_property(options ${target} INTERFACE_COMPILE_OPTIONS)
  get_target_property(definitions ${target} INTERFACE_COMPILE_DEFINITIONS)
  if(options OR definitions)
    message(FATAL_ERROR "${target} makes its users compile with ${options} ${definitions}")
  endif()
endforeach()
add_executable(consumer ${CMAKE_CURRENT_LIST_DIR}/main.cc ${CMAKE_CURRENT_LIST_DIR}/other.cc)
set_source_files_properties(${CMAKE_CURRENT_LIST_DIR}/other.cc PROPERTIES COMPILE_OPTIONS -O2)
target_link_libraries(consumer PRIVATE lvggt::lvggt)
