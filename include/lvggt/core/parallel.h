// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <type_traits>

#include "lvggt/core/context.h"

namespace lvggt {

// A reference to a callable that outlives the call it is passed to; unlike std::function it never
// allocates.
template <class Signature>
class FunctionRef;
template <class R, class... Args>
class FunctionRef<R(Args...)> {
 public:
  template <class F>
  requires(!std::is_same_v<std::remove_cvref_t<F>, FunctionRef>)
      FunctionRef(F&& f)  // NOLINT: implicit by design
      : object_(const_cast<void*>(static_cast<const void*>(std::addressof(f)))),
        call_([](void* object, Args... args) -> R {
          return (*static_cast<std::remove_reference_t<F>*>(object))(args...);
        }) {}
  R operator()(Args... args) const { return call_(object_, args...); }

 private:
  void* object_;
  R (*call_)(void*, Args...);
};

// Calls body(chunk, worker) once for every chunk in [0, num_chunks), on any thread in any order,
// and returns when all are done. `worker` is in [0, ctx.num_threads()) and names the scratch the
// chunk may use. The first exception of a body reaches the caller. Results must not depend on
// `worker`, and the number of chunks must follow from shapes alone: then they are the same bits for
// any number of threads.
void parallel_chunks(std::int64_t num_chunks,
                     FunctionRef<void(std::int64_t chunk, int worker)> body, Context& ctx);

// Splits [0, num_rows) into chunks of `grain` rows and calls body(begin, end) for each, in
// parallel.
inline void parallel_rows(std::int64_t num_rows, std::int64_t grain,
                          FunctionRef<void(std::int64_t begin, std::int64_t end)> body,
                          Context& ctx) {
  grain = std::max<std::int64_t>(grain, 1);
  parallel_chunks((num_rows + grain - 1) / grain,
                  [&](std::int64_t chunk, int) {
                    body(chunk * grain, std::min(num_rows, (chunk + 1) * grain));
                  },
                  ctx);
}

}  // namespace lvggt
