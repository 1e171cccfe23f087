// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "lvggt/core/reserved_memory.h"
#include "lvggt/kernels/attention.h"
#include "lvggt/model/window_policy.h"

namespace lvggt {

// Largest number of past frames a cache accepts.
inline constexpr std::int64_t kMaxPastFrames = std::int64_t{1} << 24;

// Keys and values of past frames, for every layer, packed for the attention kernel when they are
// made. Each frame has a slot in address space reserved up front: memory is committed as the first
// max_past_frames + 1 frames arrive, and nothing is allocated after construction.
//
// The running frame is what append() is given until end_frame(): it sees the cached frames and its
// own tokens, so at most max_past_frames + 1 frames. end_frame() keeps it and then, while more than
// max_past_frames are cached, evicts the frame that the policy names: by default the oldest. A
// frame that is never ended leaves no trace: the next one overwrites it.
class KvCache {
 public:
  KvCache(std::int64_t num_layers, std::int64_t num_heads, std::int64_t head_dim,
          std::int64_t tokens_per_frame, std::int64_t max_past_frames,
          Storage storage = Storage::kF32, const WindowPolicy& policy = {})
      : num_layers_(num_layers),
        num_heads_(num_heads),
        head_dim_(head_dim),
        tokens_per_frame_(tokens_per_frame),
        max_past_frames_(max_past_frames),
        storage_(storage),
        policy_(policy),
        group_bytes_(keys_values_layout(storage, num_heads, tokens_per_frame, head_dim).size) {
    if (max_past_frames < 1 || max_past_frames > kMaxPastFrames)
      fail(ErrorKind::kUsage, "kv_cache: the number of past frames must lie in [1, ",
           kMaxPastFrames, "], not ", max_past_frames);
    const double total = static_cast<double>(capacity()) * static_cast<double>(num_layers) *
                         static_cast<double>(group_bytes_);
    if (total > 1e14)  // beyond the 47 bits of address space that a process has
      fail(ErrorKind::kMemory, "kv_cache: ", max_past_frames, " past frames would take ", total,
           " bytes; a smaller window fits");
    policy.check();
    frames_ = ReservedMemory(static_cast<std::size_t>(capacity()) * sizeof(std::int64_t));
    slots_ = ReservedMemory(static_cast<std::size_t>(capacity()) * sizeof(std::int64_t));
    groups_ = ReservedMemory(static_cast<std::size_t>(capacity()) * sizeof(PackedKeysValues));
    packed_ = ReservedMemory(static_cast<std::size_t>(capacity() * num_layers * group_bytes_));
  }

  // Keys and values of the running frame's tokens in one layer; a second call replaces the first.
  //   k, v: [n, heads, D], n at most tokens_per_frame
  void append(std::int64_t layer, View<const float, 3> k, View<const float, 3> v, Context& ctx) {
    LVGGT_CHECK(k.extent(0) <= tokens_per_frame_, "kv_cache: ", k.extent(0),
                " tokens where a frame has at most ", tokens_per_frame_);
    running_tokens_ = k.extent(0);
    pack_keys_values(group(num_frames_, layer), k, v, ctx);
  }

  // All groups that the running frame sees in a layer, oldest first, its own last; valid until the
  // next call.
  std::span<const PackedKeysValues> attended(std::int64_t layer) {
    auto* groups = reinterpret_cast<PackedKeysValues*>(groups_.data());
    for (std::int64_t i = 0; i <= num_frames_; ++i) groups[i] = group(i, layer);
    return {groups, static_cast<std::size_t>(num_frames_ + 1)};
  }

  void end_frame() {
    frames()[num_frames_++] = frames_seen_++;
    std::int64_t free_slot = num_frames_;  // not used yet, while the window fills
    while (num_frames_ > max_past_frames_) free_slot = evict();
    slots()[num_frames_] = free_slot;
  }

  std::int64_t num_frames() const { return num_frames_; }  // cached, without the running one
  // Their numbers in the stream, oldest first; valid until the next frame ends.
  std::span<const std::int64_t> cached_frames() const {
    return {frames(), static_cast<std::size_t>(num_frames_)};
  }

  // Bytes of a full cache.
  std::size_t max_bytes() const { return packed_.num_bytes(); }

 private:
  std::int64_t capacity() const { return max_past_frames_ + 1; }

  // Of the cached frames, oldest first, and of the running one: the number in the stream, the slot.
  std::int64_t* frames() const { return reinterpret_cast<std::int64_t*>(frames_.data()); }
  std::int64_t* slots() const { return reinterpret_cast<std::int64_t*>(slots_.data()); }

  // Forgets one frame; returns its slot.
  std::int64_t evict() {
    const std::int64_t idx = policy_.evicted({frames(), static_cast<std::size_t>(num_frames_)});
    const std::int64_t slot = slots()[idx];
    std::copy(frames() + idx + 1, frames() + num_frames_, frames() + idx);
    std::copy(slots() + idx + 1, slots() + num_frames_, slots() + idx);
    --num_frames_;
    return slot;
  }

  // Frame `idx` counted from the oldest; idx == num_frames() is the running one. The layers of a
  // frame lie side by side, so that memory is committed frame by frame.
  PackedKeysValues group(std::int64_t idx, std::int64_t layer) const {
    const std::int64_t tokens = idx == num_frames_ ? running_tokens_ : tokens_per_frame_;
    return {packed_.data() + (slots()[idx] * num_layers_ + layer) * group_bytes_, storage_,
            num_heads_, tokens, head_dim_};
  }

  std::int64_t num_layers_, num_heads_, head_dim_, tokens_per_frame_, max_past_frames_;
  Storage storage_;
  WindowPolicy policy_;
  std::int64_t group_bytes_;  // of one frame in one layer
  std::int64_t num_frames_ = 0;
  std::int64_t frames_seen_ = 0;  // ended, cached or not
  std::int64_t running_tokens_ = 0;
  ReservedMemory frames_;  // int64 [capacity]
  ReservedMemory slots_;   // int64 [capacity]
  ReservedMemory groups_;  // PackedKeysValues [capacity]
  ReservedMemory packed_;  // [capacity, layers, group_bytes_]
};

}  // namespace lvggt
