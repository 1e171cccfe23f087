// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/lift_first.h"

#include <cstdio>

#include "examples/lift_plan.h"
#include "lvggt/cli/bundled_model.h"
#include "lvggt/cli/interrupt.h"

namespace query_video {

using namespace lvggt;

namespace {

void say(const std::string& line) { std::fprintf(stderr, "query_video: %s\n", line.c_str()); }

LiftOptions lift_options_of(const Options& o, const std::string& folder) {
  LiftOptions lift;
  lift.video = o.field;
  lift.out = folder;
  lift.size = o.size;
  lift.weights.weights = o.weights;
  lift.weights.decoder = o.decoder;
  lift.weights.state_decoder = o.state_decoder;
  lift.weights.config = o.config;
  lift.stream.max_past_frames = o.max_past_frames;
  lift.memory_limit = o.memory_limit;
  lift.no_ply = lift.no_rgb = lift.no_semantics = lift.no_colmap = lift.no_contact_sheet = true;
  lift.settle();
  lift.stream.rgb = false;
  return lift;
}

}  // namespace

void lift_first(const Options& o, const std::string& folder, const std::function<void()>& prepare,
                Context& ctx) {
  LiftOptions lift = lift_options_of(o, folder);
  cli::default_to_small_model(lift.weights.weights, say);
  const lift_plan::ModelFiles files(lift.weights);
  lift.preprocess.size =
      lift.size > 0 ? lift.size : static_cast<int>(files.checkpoint().config().img_size);
  lift_plan::Input input = lift_plan::open_input(lift);
  const lift_plan::Plan plan = lift_plan::plan_run(files, lift, input.transform,
                                                   lift_plan::reachable_past_frames(lift, input),
                                                   lift_plan::num_frames(input));
  lift_plan::check_plan(plan, files, lift, input);
  say(concat("lifting ", o.field, " first, about ", cli::bytes_text(plan.total), " of memory (",
             lift_plan::breakdown(plan), ")"));

  const LangVggt model = LangVggt::load(lift.weights, ctx);
  for (const std::string& warning : cli::load_warnings(model, lift.weights.weights))
    say("warning: " + warning);
  prepare();
  cli::create_output_folder(folder);
  RunFormat format = lift_plan::run_format(lift, input, files, ctx);
  format.has_rgb = false;
  RunWriter writer(folder, lift.outputs, format, false);
  Stream stream(model, ctx, lift.stream);
  cli::Progress progress(format.expected_frames);
  const cli::InterruptGuard interrupt;
  for (; input.next && !interrupt.requested(); input.next = input.source->next()) {
    const PreparedFrame prepared = prepare_frame(input.next->image, lift.preprocess);
    const Frame frame = stream.push(prepared.pixels);
    writer.write(
        {{frame.index, input.next->source_index, input.next->name, input.next->timestamp,
          frame.camera},
         input.next->image.pixels,
         {prepared.pixels, frame.depth, frame.depth_confidence, {}, frame.language, frame.states}},
        [] { return false; }, ctx);
    progress.show(writer.num_frames());
  }
  writer.finish();
  progress.clear();
  for (const std::string& warning : input.source->warnings()) say("warning: " + warning);
  if (input.next)
    fail(ErrorKind::kInterrupted, "interrupted: ", writer.num_frames(), " frames are in ", folder);
}

}  // namespace query_video
