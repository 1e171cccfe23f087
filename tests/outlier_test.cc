// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/outlier.h"

#include <doctest/doctest.h>

#include <limits>

namespace {
using lvggt::OutlierDetector;
}

TEST_CASE("D27: a jump has a large z-score once the window holds enough values, noise has not") {
  OutlierDetector detector;
  for (std::size_t i = 0; i < OutlierDetector::kFewest; ++i)
    CHECK_FALSE(detector.add(i % 2 == 0 ? 1.0 : 1.2));
  CHECK(*detector.add(1.1) == doctest::Approx(0).epsilon(1e-9));
  CHECK(*detector.add(1.2) == doctest::Approx(1).epsilon(0.1));
  CHECK(*detector.add(3.1) > 15);
  CHECK_FALSE(detector.add(std::numeric_limits<double>::quiet_NaN()));
  // The window forgets: after as many values of the new kind they are the rule.
  for (std::size_t i = 0; i < OutlierDetector::kWindow; ++i) detector.add(i % 2 == 0 ? 3.0 : 3.2);
  CHECK(*detector.add(3.1) == doctest::Approx(0).epsilon(1e-6));
}

TEST_CASE("OutlierDetector: equal values have no deviation to measure by") {
  OutlierDetector detector;
  for (int i = 0; i < 40; ++i) CHECK_FALSE(detector.add(2));
  CHECK_FALSE(detector.add(5));
}

TEST_CASE("OutlierDetector: its text brings back the same bits") {
  OutlierDetector detector;
  for (int i = 0; i < 200; ++i) detector.add(1.0 / (i + 3));
  OutlierDetector again = OutlierDetector::parse(detector.text());
  CHECK(again.text() == detector.text());
  CHECK(*again.add(0.7) == *detector.add(0.7));
  CHECK(OutlierDetector::parse("").text().empty());
  CHECK_THROWS(OutlierDetector::parse("1 x"));
}
