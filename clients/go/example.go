// The flow of one pair over gRPC: reads two files of packed float32 x y z, writes packed float32 displacements.
//
//	example HOST:PORT source.f32 target.f32 flow.f32
package main

import (
	"bufio"
	"context"
	"errors"
	"fmt"
	"io"
	"os"
	"time"

	"google.golang.org/grpc"

	"fnsf/v1"
)

// 48 Ki points stay below the 1 MiB that the server takes in a message.
const chunkBytes = 48 * 1024 * 12

func main() {
	if len(os.Args) != 5 {
		fmt.Fprintln(os.Stderr, "example HOST:PORT source.f32 target.f32 flow.f32")
		os.Exit(2)
	}
	if err := estimate(os.Args[1], os.Args[2], os.Args[3], os.Args[4]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(70)
	}
}

func estimate(address, source, target, flow string) error {
	// Since 1.43: grpc.WithTransportCredentials(insecure.NewCredentials()).
	connection, err := grpc.Dial(address, grpc.WithInsecure())
	if err != nil {
		return err
	}
	defer connection.Close()
	// The best flow that 30 seconds allow.
	deadline, cancel := context.WithTimeout(context.Background(), 30*time.Second)
	defer cancel()
	call, err := fnsfv1.NewSceneFlowClient(connection).EstimateFlow(deadline)
	if err != nil {
		return err
	}
	begin := &fnsfv1.EstimateFlowRequest_Begin{Options: &fnsfv1.Options{Preset: fnsfv1.Preset_PRESET_DEFAULT}}
	err = call.Send(&fnsfv1.EstimateFlowRequest{Part: &fnsfv1.EstimateFlowRequest_Begin_{Begin: begin}})
	if err == nil {
		err = send(call, fnsfv1.Cloud_CLOUD_SOURCE, source)
	}
	if err == nil {
		err = send(call, fnsfv1.Cloud_CLOUD_TARGET, target)
	}
	// io.EOF says that the server has ended the call. Why, its answer says.
	if err != nil && !errors.Is(err, io.EOF) {
		return err
	}
	if err := call.CloseSend(); err != nil {
		return err
	}
	return receive(call, flow)
}

func send(call fnsfv1.SceneFlow_EstimateFlowClient, cloud fnsfv1.Cloud, path string) error {
	points, err := os.ReadFile(path)
	if err != nil {
		return err
	}
	for len(points) > 0 {
		size := min(len(points), chunkBytes)
		chunk := &fnsfv1.EstimateFlowRequest_CloudChunk{
			Cloud: cloud,
			Chunk: &fnsfv1.Chunk{Points: points[:size]},
		}
		part := &fnsfv1.EstimateFlowRequest{Part: &fnsfv1.EstimateFlowRequest_Cloud{Cloud: chunk}}
		if err := call.Send(part); err != nil {
			return err
		}
		points = points[size:]
	}
	return nil
}

func receive(call fnsfv1.SceneFlow_EstimateFlowClient, path string) error {
	file, err := os.Create(path)
	if err != nil {
		return err
	}
	defer file.Close()
	out := bufio.NewWriter(file)
	for {
		answer, err := call.Recv()
		if errors.Is(err, io.EOF) {
			return out.Flush()
		}
		if err != nil {
			return fmt.Errorf("the server refused: %w", err)
		}
		if header := answer.GetHeader(); header != nil {
			fmt.Printf("%d of %d points, %s, %d objects move\n", header.ValidPoints, header.Points,
				header.StopReason, header.GetObjects().GetMoving())
		}
		if _, err := out.Write(answer.GetChunk().GetFlow()); err != nil {
			return err
		}
	}
}

func min(a, b int) int {
	if a < b {
		return a
	}
	return b
}
