// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/decoded_cosines.h"

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <algorithm>
#include <cmath>

#include "kernels/grain.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/linear.h"

namespace lvggt {
namespace {

using Matrix = Eigen::MatrixXd;

// Rows of R that are multiplied together: fewer save more of the zeros before them, more make
// better products. Panels are 16 wide.
std::int64_t block_rows(std::int64_t rows) { return rows < 1024 ? 128 : 256; }

// (W b)^T (W b) in double, its columns in parallel.   weight: [D, K]   bias: [D]
Matrix gram_matrix(View<const float, 2> weight, View<const float, 1> bias, Context& ctx) {
  const std::int64_t D = weight.extent(0), K = weight.extent(1);
  Matrix columns(D, K + 1);
  for (std::int64_t i = 0; i < D; ++i) {
    for (std::int64_t k = 0; k < K; ++k) columns(i, k) = weight(i, k);
    columns(i, K) = bias[i];
  }
  Matrix gram = Matrix::Zero(K + 1, K + 1);
  constexpr std::int64_t kColumns = 64;
  parallel_rows(
      K + 1, kColumns,
      [&](std::int64_t begin, std::int64_t end) {
        // The upper triangle only: rows up to the last of these columns.
        gram.block(0, begin, end, end - begin).noalias() =
            columns.leftCols(end).transpose() * columns.middleCols(begin, end - begin);
      },
      ctx);
  return gram;
}

// The upper triangular factor R of gram = R^T R. Hidden units that are never active or repeat each
// other leave the matrix singular; 1e-14 of its mean diagonal on all of it changes no length
// visibly and keeps the factor real.
Matrix upper_factor(Matrix gram) {
  const auto n = static_cast<double>(gram.rows());
  for (double ridge = 1e-14 * gram.trace() / n; std::isfinite(ridge); ridge *= 100) {
    gram.diagonal().array() += ridge;
    const Eigen::LLT<Matrix, Eigen::Upper> factor(gram);
    if (factor.info() == Eigen::Success) return factor.matrixU();
    if (ridge == 0) break;
  }
  return Matrix::Zero(gram.rows(), gram.cols());  // a layer of zeros
}

// sums[i] += |row i|^2.   sums: [N]   rows: [N, C]
void add_squares(View<float, 1> sums, View<const float, 2> rows, Context& ctx) {
  const std::int64_t C = rows.extent(1);
  parallel_rows(
      rows.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const float* x = rows.data() + n * rows.stride(0);
          float lanes[16] = {};
          std::int64_t c = 0;
          for (; c + 16 <= C; c += 16)
            for (std::int64_t j = 0; j < 16; ++j) lanes[j] += x[c + j] * x[c + j];
          float sum = 0;
          for (; c < C; ++c) sum += x[c] * x[c];
          for (const float lane : lanes) sum += lane;
          sums[n] += sum;
        }
      },
      ctx);
}

}  // namespace

DecodedCosines::DecodedCosines(const Autoencoder& autoencoder, Context& ctx)
    : autoencoder_(&autoencoder), feature_width_(autoencoder.feature_width()) {
  factor_last_layer(ctx);
}

DecodedCosines::DecodedCosines(std::int64_t feature_width) : feature_width_(feature_width) {
  LVGGT_CHECK(feature_width >= 1, "cosines: features are ", feature_width, " wide");
}

std::int64_t DecodedCosines::code_width() const {
  return autoencoder_ ? autoencoder_->code_width() : feature_width_;
}

void DecodedCosines::factor_last_layer(Context& ctx) {
  const View<const float, 2> weight = autoencoder_->last_weight();
  const View<const float, 1> bias = autoencoder_->last_bias();
  const std::int64_t D = weight.extent(0), K = weight.extent(1);
  if (D <= K + 1) {
    Tensor<float, 1> copy(Shape{D});
    std::copy_n(bias.data(), D, copy.data());
    blocks_.push_back({0, pack_linear(weight), std::move(copy)});
    return;
  }
  const Matrix R = upper_factor(gram_matrix(weight, bias, ctx));
  const std::int64_t step = block_rows(K);
  for (std::int64_t begin = 0; begin < K; begin += step) {
    const std::int64_t end = std::min(begin + step, K);
    Tensor<float, 2> rows(Shape{end - begin, K - begin});
    Tensor<float, 1> last(Shape{end - begin});
    for (std::int64_t i = begin; i < end; ++i) {
      for (std::int64_t k = i; k < K; ++k) rows(i - begin, k - begin) = static_cast<float>(R(i, k));
      last[i - begin] = static_cast<float>(R(i, K));
    }
    blocks_.push_back({begin, pack_linear(rows.view()), std::move(last)});
  }
  rest_ = static_cast<float>(R(K, K));
}

DecodedCosines::Vectors DecodedCosines::prepare(View<const float, 2> vectors, Context& ctx) const {
  LVGGT_CHECK(vectors.extent(1) == feature_width_, "cosines: the embeddings are ",
              vectors.extent(1), " wide but the ",
              autoencoder_ ? "autoencoder decodes to " : "features have ", feature_width_);
  Vectors prepared;
  if (!autoencoder_) {
    prepared.weight = pack_linear(vectors);
    return prepared;
  }
  const View<const float, 2> weight = autoencoder_->last_weight();
  const View<const float, 1> bias = autoencoder_->last_bias();
  const std::int64_t n = vectors.extent(0), D = weight.extent(0), K = weight.extent(1);
  Tensor<float, 2> folded(Shape{n, K});
  prepared.bias = Tensor<float, 1>(Shape{n});
  parallel_chunks(
      n,
      [&](std::int64_t i, int) {
        std::vector<double> sums(static_cast<std::size_t>(K));
        double constant = 0;
        for (std::int64_t c = 0; c < D; ++c) {
          const double v = vectors(i, c);
          constant += v * bias[c];
          const float* row = weight.data() + c * weight.stride(0);
          for (std::size_t k = 0; k < sums.size(); ++k) sums[k] += v * row[k];
        }
        for (std::int64_t k = 0; k < K; ++k)
          folded(i, k) = static_cast<float>(sums[static_cast<std::size_t>(k)]);
        prepared.bias[i] = static_cast<float>(constant);
      },
      ctx);
  prepared.weight = pack_linear(folded.view());
  return prepared;
}

void DecodedCosines::lengths(View<float, 1> length, View<const float, 2> hidden,
                             Context& ctx) const {
  const std::int64_t N = hidden.extent(0);
  std::fill_n(length.data(), N, rest_ * rest_);
  if (!autoencoder_) {
    add_squares(length, hidden, ctx);
  } else {
    for (const Block& block : blocks_) {
      Arena::Scope scope(ctx.arena());
      const View<float, 2> rows = ctx.arena().alloc(Shape{N, block.weight.N});
      linear_forward(rows, hidden.narrow(1, block.begin, hidden.extent(1)), block.weight,
                     Epilogue<2>{.bias = block.bias}, ctx);
      add_squares(length, rows, ctx);
    }
  }
  for (std::int64_t n = 0; n < N; ++n) length[n] = std::sqrt(length[n]);
}

void DecodedCosines::cosines(View<float, 2> out, View<const float, 2> codes, const Vectors& vectors,
                             Context& ctx) const {
  const std::int64_t N = codes.extent(0), n = vectors.count();
  LVGGT_CHECK(codes.extent(1) == code_width(), "cosines: the codes are ", codes.extent(1),
              " wide but the ", autoencoder_ ? "autoencoder takes " : "features have ",
              code_width());
  LVGGT_CHECK(out.shape() == (Shape{N, n}), "cosines: out is ", out.shape(), ", not ", Shape{N, n});
  for (std::int64_t begin = 0; begin < N; begin += kTileRows) {
    const std::int64_t end = std::min(begin + kTileRows, N);
    Arena::Scope scope(ctx.arena());
    View<const float, 2> hidden = codes.narrow(0, begin, end);
    if (autoencoder_) {
      const View<float, 2> decoded =
          ctx.arena().alloc(Shape{end - begin, autoencoder_->hidden_width()});
      autoencoder_->decode_hidden(decoded, hidden, ctx);
      hidden = decoded;
    }
    const View<float, 1> length = ctx.arena().alloc(Shape{end - begin});
    lengths(length, hidden, ctx);
    const View<float, 2> tile = out.narrow(0, begin, end);
    Epilogue<2> epilogue;
    if (!vectors.bias.empty()) epilogue.bias = vectors.bias;
    linear_forward(tile, hidden, vectors.weight, epilogue, ctx);
    for (std::int64_t i = 0; i < end - begin; ++i) {
      const float scale = length[i] > 0 ? 1 / length[i] : 0;
      for (std::int64_t j = 0; j < n; ++j) tile(i, j) *= scale;
    }
  }
}

}  // namespace lvggt
