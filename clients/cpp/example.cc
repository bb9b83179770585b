// The flow of one pair over gRPC: reads two files of packed float32 x y z, writes packed float32 displacements.
//
//   example HOST:PORT source.f32 target.f32 flow.f32

#include <grpcpp/grpcpp.h>

#include <fstream>
#include <iostream>
#include <iterator>
#include <string>

#include "fnsf/v1/scene_flow.grpc.pb.h"

namespace v1 = fnsf::v1;

namespace {

// 48 Ki points stay below the 1 MiB that the server takes in a message.
constexpr std::size_t kChunkBytes = 48 * 1024 * 12;

std::string ReadFile(const char* path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) {
    std::cerr << path << " cannot be read\n";
    std::exit(65);
  }
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 5) {
    std::cerr << "example HOST:PORT source.f32 target.f32 flow.f32\n";
    return 2;
  }
  auto stub = v1::SceneFlow::NewStub(grpc::CreateChannel(argv[1], grpc::InsecureChannelCredentials()));
  grpc::ClientContext context;
  // The best flow that 30 seconds allow.
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
  auto call = stub->EstimateFlow(&context);

  v1::EstimateFlowRequest request;
  request.mutable_begin()->mutable_options()->set_preset(v1::PRESET_DEFAULT);
  bool sent = call->Write(request);
  for (const v1::Cloud cloud : {v1::CLOUD_SOURCE, v1::CLOUD_TARGET}) {
    const std::string points = ReadFile(argv[cloud == v1::CLOUD_SOURCE ? 2 : 3]);
    for (std::size_t at = 0; sent && at < points.size(); at += kChunkBytes) {
      v1::EstimateFlowRequest part;
      part.mutable_cloud()->set_cloud(cloud);
      part.mutable_cloud()->mutable_chunk()->set_points(points.substr(at, kChunkBytes));
      sent = call->Write(part);
    }
  }
  call->WritesDone();

  std::ofstream out(argv[4], std::ios::binary);
  v1::EstimateFlowResponse answer;
  while (call->Read(&answer)) {
    if (answer.has_header()) {
      const auto& header = answer.header();
      std::cout << header.valid_points() << " of " << header.points() << " points, " << v1::StopReason_Name(header.stop_reason()) << ", "
                << header.objects().moving() << " objects move\n";
    } else if (answer.has_chunk()) {
      out << answer.chunk().flow();
    }
  }
  const grpc::Status status = call->Finish();
  if (!status.ok()) {
    std::cerr << "the server refused: " << status.error_message() << "\n";
    return 70;
  }
  return 0;
}
