// The flow of one pair over gRPC: reads two files of packed float32 x y z, writes packed float32 displacements.
//
//   java Example HOST:PORT source.f32 target.f32 flow.f32

import com.google.protobuf.ByteString;
import fnsf.v1.Chunk;
import fnsf.v1.Cloud;
import fnsf.v1.EstimateFlowRequest;
import fnsf.v1.EstimateFlowResponse;
import fnsf.v1.FlowHeader;
import fnsf.v1.Options;
import fnsf.v1.Preset;
import fnsf.v1.SceneFlowGrpc;
import io.grpc.ManagedChannel;
import io.grpc.ManagedChannelBuilder;
import io.grpc.Status;
import io.grpc.stub.ClientCallStreamObserver;
import io.grpc.stub.ClientResponseObserver;
import java.io.IOException;
import java.io.OutputStream;
import java.io.UncheckedIOException;
import java.nio.file.Files;
import java.nio.file.Path;
import java.util.ArrayDeque;
import java.util.Queue;
import java.util.concurrent.CompletableFuture;
import java.util.concurrent.TimeUnit;

final class Example {
  /** 48 Ki points stay below the 1 MiB that the server takes in a message. */
  private static final int CHUNK_BYTES = 48 * 1024 * 12;

  public static void main(String[] args) throws Exception {
    if (args.length != 4) {
      System.err.println("java Example HOST:PORT source.f32 target.f32 flow.f32");
      System.exit(2);
    }
    Queue<EstimateFlowRequest> parts = new ArrayDeque<>();
    Options options = Options.newBuilder().setPreset(Preset.PRESET_DEFAULT).build();
    EstimateFlowRequest.Begin begin = EstimateFlowRequest.Begin.newBuilder().setOptions(options).build();
    parts.add(EstimateFlowRequest.newBuilder().setBegin(begin).build());
    addCloud(parts, Cloud.CLOUD_SOURCE, Path.of(args[1]));
    addCloud(parts, Cloud.CLOUD_TARGET, Path.of(args[2]));

    ManagedChannel channel = ManagedChannelBuilder.forTarget(args[0]).usePlaintext().build();
    try (OutputStream out = Files.newOutputStream(Path.of(args[3]))) {
      Answers answers = new Answers(parts, out);
      // The best flow that 30 seconds allow.
      SceneFlowGrpc.newStub(channel).withDeadlineAfter(30, TimeUnit.SECONDS).estimateFlow(answers);
      answers.ended.join();
    } catch (java.util.concurrent.CompletionException failure) {
      System.err.println("the server refused: " + Status.fromThrowable(failure.getCause()).getDescription());
      System.exit(70);
    } finally {
      channel.shutdownNow();
    }
  }

  private static void addCloud(Queue<EstimateFlowRequest> parts, Cloud cloud, Path path) throws IOException {
    byte[] points = Files.readAllBytes(path);
    for (int at = 0; at < points.length; at += CHUNK_BYTES) {
      ByteString piece = ByteString.copyFrom(points, at, Math.min(CHUNK_BYTES, points.length - at));
      EstimateFlowRequest.CloudChunk chunk =
          EstimateFlowRequest.CloudChunk.newBuilder()
              .setCloud(cloud)
              .setChunk(Chunk.newBuilder().setPoints(piece))
              .build();
      parts.add(EstimateFlowRequest.newBuilder().setCloud(chunk).build());
    }
  }

  /** Sends the parts as the server takes them, and writes the flow. */
  private static final class Answers
      implements ClientResponseObserver<EstimateFlowRequest, EstimateFlowResponse> {
    final CompletableFuture<Void> ended = new CompletableFuture<>();
    private final Queue<EstimateFlowRequest> parts;
    private final OutputStream out;

    Answers(Queue<EstimateFlowRequest> parts, OutputStream out) {
      this.parts = parts;
      this.out = out;
    }

    @Override
    public void beforeStart(ClientCallStreamObserver<EstimateFlowRequest> call) {
      call.setOnReadyHandler(
          () -> {
            while (call.isReady() && !parts.isEmpty()) {
              call.onNext(parts.remove());
              if (parts.isEmpty()) {
                call.onCompleted();
              }
            }
          });
    }

    @Override
    public void onNext(EstimateFlowResponse answer) {
      if (answer.hasHeader()) {
        FlowHeader header = answer.getHeader();
        System.out.printf(
            "%d of %d points, %s, %d objects move%n",
            header.getValidPoints(),
            header.getPoints(),
            header.getStopReason(),
            header.getObjects().getMoving());
      } else if (answer.hasChunk()) {
        try {
          answer.getChunk().getFlow().writeTo(out);
        } catch (IOException failure) {
          throw new UncheckedIOException(failure);
        }
      }
    }

    @Override
    public void onError(Throwable failure) {
      ended.completeExceptionally(failure);
    }

    @Override
    public void onCompleted() {
      ended.complete(null);
    }
  }
}
