// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/loss.h"

#include <algorithm>
#include <cmath>

#include "kernels/grain.h"
#include "lvggt/core/parallel.h"

namespace lvggt {
namespace {

void check_shapes(const char* op, View<const float, 4> a, View<const float, 4> b,
                  View<const float, 3> mask) {
  LVGGT_CHECK(a.shape() == b.shape(), op, ": a is ", a.shape(), " but b is ", b.shape());
  const Shape pixels{a.extent(0), a.extent(1), a.extent(2)};
  LVGGT_CHECK(mask.empty() || mask.shape() == pixels, op, ": a is ", a.shape(), " but the mask is ",
              mask.shape());
  LVGGT_CHECK(a.size() > 0, op, ": a is empty, ", a.shape());
}

void check_gradient(const char* op, View<float, 4> da, View<const float, 4> a) {
  LVGGT_CHECK(da.shape() == a.shape(), op, ": da is ", da.shape(), " but a is ", a.shape());
}

// One row of pixels.
struct Row {
  View<float, 2> da;  // [W, C]; empty in a forward pass
  View<const float, 2> a, b;
  const float* mask;  // [W], may be null

  double m(std::int64_t w) const { return mask ? mask[w] : 1.0; }
};

// Sum of visit(row) over all rows, each row on some thread, added in the order of the rows.
template <class Visit>
double sum_over_rows(View<float, 4> da, View<const float, 4> a, View<const float, 4> b,
                     View<const float, 3> mask, const Visit& visit, Context& ctx) {
  const std::int64_t H = a.extent(1), rows = a.extent(0) * H;
  Arena::Scope scope(ctx.arena());
  const View<double, 1> sums = ctx.arena().alloc<double>(Shape{rows});
  parallel_rows(
      rows, kernels::rows_per_chunk(a.extent(2) * a.extent(3)),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const std::int64_t i = n / H, h = n % H;
          sums[n] = visit(Row{da ? da[i][h] : View<float, 2>(), a[i][h], b[i][h],
                              mask ? mask[i][h].data() : nullptr});
        }
      },
      ctx);
  double sum = 0;
  for (std::int64_t n = 0; n < rows; ++n) sum += sums[n];
  return sum;
}

// Sum over all elements of term(m, a, b), which also returns the derivative of it by a; da = factor
// times that.
struct Term {
  double value, slope;
};
template <class Function>
double sum_over_elements(View<float, 4> da, double factor, View<const float, 4> a,
                         View<const float, 4> b, View<const float, 3> mask,
                         const Function& function, Context& ctx) {
  return sum_over_rows(
      da, a, b, mask,
      [&](const Row& row) {
        double sum = 0;
        for (std::int64_t w = 0; w < row.a.extent(0); ++w) {
          const float* a_row = row.a.data() + w * row.a.stride(0);
          const float* b_row = row.b.data() + w * row.b.stride(0);
          float* da_row = row.da ? row.da.data() + w * row.da.stride(0) : nullptr;
          for (std::int64_t c = 0; c < row.a.extent(1); ++c) {
            const Term term = function(row.m(w), a_row[c], b_row[c]);
            sum += term.value;
            if (da_row) da_row[c] = static_cast<float>(factor * term.slope);
          }
        }
        return sum;
      },
      ctx);
}

// Holes contribute nothing, whatever stands in them.
Term l1_term(double m, double a, double b) {
  if (m == 0) return {0, 0};
  const double error = m * (a - b);
  return {std::abs(error), error > 0 ? m : error < 0 ? -m : error};  // NaN stays NaN
}

Term mse_term(double m, double a, double b) {
  if (m == 0) return {0, 0};
  const double error = m * (a - b);
  return {error * error, 2 * m * error};
}

// Vectors inside of one row: n values, `step` apart in a and b, mask_step in the mask.
struct Vectors {
  const float* a;
  std::int64_t a_step;
  const float* b;
  std::int64_t b_step;
  float* da;  // may be null
  std::int64_t da_step;
  const float* mask;
  std::int64_t mask_step;
  std::int64_t n;

  double m(std::int64_t i) const { return mask ? mask[i * mask_step] : 1.0; }
  double u(std::int64_t i) const { return m(i) == 0 ? 0 : m(i) * a[i * a_step]; }
  double v(std::int64_t i) const { return m(i) == 0 ? 0 : m(i) * b[i * b_step]; }
};

// cos(u, v) and, if asked, da = factor * dcos/da.
double cosine(const Vectors& x, double factor) {
  double uv = 0, uu = 0, vv = 0;
  for (std::int64_t i = 0; i < x.n; ++i) {
    uv += x.u(i) * x.v(i);
    uu += x.u(i) * x.u(i);
    vv += x.v(i) * x.v(i);
  }
  const double norm_u = std::sqrt(uu), norm_v = std::sqrt(vv);
  const bool no_direction = norm_u < kShortestDirection || norm_v < kShortestDirection;
  const double cos = no_direction ? 0 : uv / (norm_u * norm_v);
  if (x.da) {
    const double along_v = no_direction ? 0 : factor / (norm_u * norm_v);
    const double along_u = no_direction ? 0 : factor * cos / uu;
    for (std::int64_t i = 0; i < x.n; ++i)
      x.da[i * x.da_step] = static_cast<float>(x.m(i) * (along_v * x.v(i) - along_u * x.u(i)));
  }
  return cos;
}

double num_vectors(const Shape<4>& shape, CosineAxis axis) {
  return static_cast<double>(shape.volume() / shape[axis == CosineAxis::kChannels ? 3 : 2]);
}

double sum_of_cosines(View<float, 4> da, double factor, View<const float, 4> a,
                      View<const float, 4> b, View<const float, 3> mask, CosineAxis axis,
                      Context& ctx) {
  return sum_over_rows(
      da, a, b, mask,
      [&](const Row& row) {
        const std::int64_t W = row.a.extent(0), C = row.a.extent(1);
        const std::int64_t sa = row.a.stride(0), sb = row.b.stride(0), sd = row.da.stride(0);
        float* da_row = row.da.data();
        double sum = 0;
        if (axis == CosineAxis::kChannels) {
          for (std::int64_t w = 0; w < W; ++w)
            sum += cosine(
                {row.a.data() + w * sa, 1, row.b.data() + w * sb, 1,
                 da_row ? da_row + w * sd : nullptr, 1, row.mask ? row.mask + w : nullptr, 0, C},
                factor);
        } else {
          for (std::int64_t c = 0; c < C; ++c)
            sum += cosine({row.a.data() + c, sa, row.b.data() + c, sb,
                           da_row ? da_row + c : nullptr, sd, row.mask, 1, W},
                          factor);
        }
        return sum;
      },
      ctx);
}

}  // namespace

double l1_loss_forward(View<const float, 4> a, View<const float, 4> b, View<const float, 3> mask,
                       Context& ctx) {
  check_shapes("l1_loss", a, b, mask);
  return sum_over_elements({}, 0, a, b, mask, l1_term, ctx) / static_cast<double>(a.size());
}

void l1_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                      View<const float, 4> b, View<const float, 3> mask, Context& ctx) {
  check_shapes("l1_loss_backward", a, b, mask);
  check_gradient("l1_loss_backward", da, a);
  sum_over_elements(da, dloss / static_cast<double>(a.size()), a, b, mask, l1_term, ctx);
}

double mse_loss_forward(View<const float, 4> a, View<const float, 4> b, View<const float, 3> mask,
                        Context& ctx) {
  check_shapes("mse_loss", a, b, mask);
  return sum_over_elements({}, 0, a, b, mask, mse_term, ctx) / static_cast<double>(a.size());
}

void mse_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                       View<const float, 4> b, View<const float, 3> mask, Context& ctx) {
  check_shapes("mse_loss_backward", a, b, mask);
  check_gradient("mse_loss_backward", da, a);
  sum_over_elements(da, dloss / static_cast<double>(a.size()), a, b, mask, mse_term, ctx);
}

double cosine_loss_forward(View<const float, 4> a, View<const float, 4> b,
                           View<const float, 3> mask, CosineAxis axis, Context& ctx) {
  check_shapes("cosine_loss", a, b, mask);
  return 1 - sum_of_cosines({}, 0, a, b, mask, axis, ctx) / num_vectors(a.shape(), axis);
}

void cosine_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                          View<const float, 4> b, View<const float, 3> mask, CosineAxis axis,
                          Context& ctx) {
  check_shapes("cosine_loss_backward", a, b, mask);
  check_gradient("cosine_loss_backward", da, a);
  sum_of_cosines(da, -dloss / num_vectors(a.shape(), axis), a, b, mask, axis, ctx);
}

}  // namespace lvggt
