// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/ranks.h"

#include <cstdio>
#include <cstdlib>
#include <new>
#include <string_view>

#include "lvggt/cli/program.h"
#include "lvggt/core/error.h"
#ifdef LVGGT_HAS_MPI
#include "lvggt/train/mpi_communicator.h"
#endif

namespace train_decoder {
namespace {

using namespace lvggt;

// A number that the launcher left in the environment, 0 if it is not there.
int launcher_number(std::initializer_list<const char*> names) {
  for (const char* name : names) {
    const char* text = std::getenv(name);
    int value = 0;
    if (text != nullptr && cli::parse_number(std::string_view(text), value)) return value;
  }
  return 0;
}

// Ranks that Open MPI's, MPICH's or Slurm's launcher started.
int launched_ranks() {
  return launcher_number({"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MPI_LOCALNRANKS"});
}

std::unique_ptr<Communicator> make_communicator([[maybe_unused]] double timeout) {
#ifdef LVGGT_HAS_MPI
  if (launched_ranks() > 0 || std::getenv("PMIX_RANK") != nullptr)
    return std::make_unique<MpiCommunicator>(timeout);
#else
  if (launched_ranks() > 1)
    fail(ErrorKind::kUsage, "mpirun started ", launched_ranks(),
         " processes, but this program was built without MPI (LVGGT_BUILD_MPI)");
#endif
  return std::make_unique<SingleProcess>();
}

}  // namespace

Ranks::Ranks(double timeout) : communicator_(make_communicator(timeout)) {}
Ranks::~Ranks() = default;

int Ranks::on_this_machine() const {
  const int local = launcher_number({"OMPI_COMM_WORLD_LOCAL_SIZE", "MPI_LOCALNRANKS"});
  return local > 0 ? local : size();
}

std::vector<std::string> Ranks::gather(const std::string& text) {
#ifdef LVGGT_HAS_MPI
  if (size() > 1) return static_cast<MpiCommunicator&>(*communicator_).gather(text);
#endif
  return {text};
}

void Ranks::together(const std::function<void()>& work) {
  if (size() == 1) return work();
  std::string fault;
  ErrorKind kind = ErrorKind::kWrite;
  try {
    work();
  } catch (const Error& error) {
    fault = error.what();
    kind = error.kind();
  } catch (const std::bad_alloc&) {
    fault = "not enough memory";
    kind = ErrorKind::kMemory;
  }
  // The kind travels with the sentence, so that all ranks end with one status.
  const auto faults =
      gather(fault.empty() ? fault : static_cast<char>('A' + static_cast<int>(kind)) + fault);
  std::string sentence;
  for (std::size_t r = 0; r < faults.size(); ++r) {
    if (faults[r].empty()) continue;
    if (sentence.empty()) kind = static_cast<ErrorKind>(faults[r][0] - 'A');
    const std::string text = faults[r].substr(1);
    if (sentence.find(text) != std::string::npos) continue;  // the same on every rank
    sentence += concat(sentence.empty() ? "" : "; ", "rank ", r, ": ", text);
  }
  if (!sentence.empty()) throw Error(kind, sentence);
}

void Ranks::check_same(const Facts& facts) {
  if (size() == 1) return;
  std::string own;
  for (const auto& [name, value] : facts) own += name + '\0' + value + '\0';
  const auto all = gather(own);
  const auto split = [](const std::string& text) {
    std::vector<std::string> parts;
    for (std::size_t first = 0; first < text.size();) {
      const std::size_t end = text.find('\0', first);
      parts.push_back(text.substr(first, end - first));
      first = end + 1;
    }
    return parts;
  };
  const std::vector<std::string> wanted = split(all[0]);
  std::string differences;
  for (std::size_t r = 1; r < all.size(); ++r) {
    const std::vector<std::string> found = split(all[r]);
    if (found.size() != wanted.size()) {
      differences += concat(differences.empty() ? "" : "; ", "rank ", r, " has other settings");
      continue;
    }
    for (std::size_t i = 0; i + 1 < wanted.size(); i += 2)
      if (found[i] != wanted[i] || found[i + 1] != wanted[i + 1])
        differences += concat(differences.empty() ? "" : "; ", wanted[i], " is ", wanted[i + 1],
                              " on rank 0 but ", found[i + 1], " on rank ", r);
  }
  LVGGT_CHECK(differences.empty(), "the ranks do not train the same: ", differences);
}

int Ranks::guarded(const std::function<int()>& body) {
  if (size() == 1) return body();
  std::string sentence;
  int status = 1;
  try {
    return body();
  } catch (const Error& error) {
    sentence = error.what();
    status = exit_code(error.kind());
  } catch (const std::bad_alloc&) {
    sentence = "not enough memory";
    status = exit_code(ErrorKind::kMemory);
  } catch (const std::exception& error) {
    sentence = error.what();
  }
  std::fprintf(stderr,
               "train_decoder: error: rank %d of %d: %s; all ranks stop, and the last checkpoint "
               "stays valid (--resume)\n",
               rank(), size(), sentence.c_str());
#ifdef LVGGT_HAS_MPI
  static_cast<MpiCommunicator&>(*communicator_).end_all(status);
#else
  return status;
#endif
}

}  // namespace train_decoder
