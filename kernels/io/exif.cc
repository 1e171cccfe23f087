// SPDX-License-Identifier: Apache-2.0
#include <libexif/exif-data.h>
#include <libexif/exif-utils.h>

#include <memory>

#include "kernels/io/image_check.h"
#include "lvggt/core/error.h"

namespace lvggt::detail {

int exif_orientation(std::span<const std::byte> exif, const std::string& name,
                     std::vector<std::string>& notes) {
  struct Free {
    void operator()(ExifData* data) const { exif_data_unref(data); }
  };
  const std::unique_ptr<ExifData, Free> data(exif_data_new_from_data(
      reinterpret_cast<const unsigned char*>(exif.data()), static_cast<unsigned>(exif.size())));
  if (!data) return 1;
  const ExifEntry* entry = exif_content_get_entry(data->ifd[EXIF_IFD_0], EXIF_TAG_ORIENTATION);
  if (!entry || entry->format != EXIF_FORMAT_SHORT || entry->components < 1 || entry->size < 2)
    return 1;
  const int orientation = exif_get_short(entry->data, exif_data_get_byte_order(data.get()));
  if (orientation >= 1 && orientation <= 8) return orientation;
  notes.push_back(concat(name, ": the EXIF orientation ", orientation,
                         " is not between 1 and 8 and is ignored"));
  return 1;
}

}  // namespace lvggt::detail
