// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "lvggt/core/reserved_memory.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Scratch memory handed out by bumping an offset and taken back as a whole when a Scope ends. It
// lies in address space reserved with room to grow, of which only what was handed out is ever
// committed. Where there is no such room it grows block by block; when the outermost scope ends the
// blocks are merged into one as large as the peak. Either way the same work done again does not
// touch the heap. Not thread-safe: one arena belongs to one caller.
class Arena {
 public:
  Arena() = default;
  Arena(const Arena&) = delete;
  Arena& operator=(const Arena&) = delete;

  // Everything allocated after a Scope opens is released when it ends; scopes nest.
  class Scope {
   public:
    explicit Scope(Arena& arena)
        : arena_(arena), block_(arena.block_), used_(arena.used_), live_(arena.live_) {
      ++arena.depth_;
    }
    ~Scope() {
      arena_.block_ = block_;
      arena_.used_ = used_;
      arena_.live_ = live_;
      if (--arena_.depth_ == 0) arena_.merge();
    }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;

   private:
    Arena& arena_;
    std::size_t block_;
    std::size_t used_;
    std::size_t live_;
  };

  // An uninitialised dense array, valid until the innermost open scope ends.
  template <class T = float, int R>
  View<T, R> alloc(Shape<R> shape) {
    return View<T, R>(
        reinterpret_cast<T*>(alloc_bytes(static_cast<std::size_t>(shape.volume()) * sizeof(T))),
        shape);
  }

  // Most bytes ever in use at once.
  std::size_t peak_bytes() const { return peak_; }

 private:
  std::byte* alloc_bytes(std::size_t bytes) {
    LVGGT_CHECK(depth_ > 0, "arena: allocation outside of a scope");
    bytes = (bytes + kAlignment - 1) / kAlignment * kAlignment;
    while (block_ < blocks_.size() && used_ + bytes > blocks_[block_].num_bytes()) {
      ++block_;
      used_ = 0;
    }
    if (block_ == blocks_.size()) {
      // At least half of what there is already, so that few blocks suffice whatever the request
      // sizes.
      std::size_t total = 0;
      for (const auto& block : blocks_) total += block.num_bytes();
      const std::size_t size = std::max({bytes, total / 2, kMinBlock});
      blocks_.push_back(blocks_.empty() ? reserve_with_room(size) : ReservedMemory(size));
      used_ = 0;
    }
    std::byte* p = blocks_[block_].data() + used_;
    used_ += bytes;
    live_ += bytes;
    peak_ = std::max(peak_, live_);
    return p;
  }

  void merge() {
    if (blocks_.size() < 2) return;
    blocks_.clear();
    blocks_.emplace_back(peak_);
  }

  static constexpr std::size_t kMinBlock = std::size_t{1} << 20;
  std::vector<ReservedMemory> blocks_;
  std::size_t block_ = 0;  // current block and the bytes used in it
  std::size_t used_ = 0;
  std::size_t live_ = 0;  // bytes handed out, without the unused ends of earlier blocks
  std::size_t peak_ = 0;  // largest live_
  int depth_ = 0;
};

}  // namespace lvggt
