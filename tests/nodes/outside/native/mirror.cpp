// Answers each frame with what it saw of it: see test_clients.py.

#include <cmath>
#include <cstdio>
#include <numeric>

#include "visnav_link.hpp"

int main() try {
    visnav::Link link("mirror");
    const visnav::Camera camera = link.camera(0);
    link.log(camera.name + " " + std::to_string(camera.width) + " " + camera.distortion_model +
             " " + std::to_string(camera.distortion.size()) + " " +
             std::to_string(std::lround(1000 * camera.fx)) + " " +
             link.description().text("clock.kind"));
    link.ready(visnav::Link::PoseOf::camera, true);
    std::vector<visnav::StampedPose> trajectory;
    while (const auto frame = link.next()) {
        trajectory.push_back({frame->stamp, visnav::Pose::from_quaternion(double(trajectory.size()), 0, 0, 0, 0, 0, 1)});
        double colours = 0, depths = 0, imu = 0;
        const visnav::Image &rgb = frame->image("rgb8"), &depth = frame->image("depth32f");
        for (int v = 0; v < rgb.height; ++v) {
            colours = std::accumulate(rgb.row<std::uint8_t>(v), rgb.row<std::uint8_t>(v) + 3 * rgb.width, colours);
            depths = std::accumulate(depth.row<float>(v), depth.row<float>(v) + depth.width, depths);
        }
        for (const visnav::Imu& sample : frame->rows<visnav::Imu>("imu"))
            imu += double(sample.stamp) + sample.angular_velocity[2] + sample.linear_acceleration[0];
        std::vector<double> covariance(36);
        const double velocity[3] = {double(frame->sequence), 2, 3};
        std::iota(covariance.begin(), covariance.end(), double(frame->sequence));
        switch (frame->sequence % 4) {
        case 0: link.pose(*frame, visnav::Pose::from_quaternion(colours, depths, imu, 0, 0, 0, 2)); break;
        case 1: link.pose(*frame, visnav::Pose::from_quaternion(colours, depths, imu, 0.5, 0.5, 0.5, 0.5),
                          visnav::Link::Status::tracked, {1, 2, 3, 4}, {1, 0}, covariance.data(), velocity); break;
        case 2: frame->sequence % 8 == 2 ? link.lost(*frame) : link.initialising(*frame); break;
        default: link.done(*frame);
        }
    }
    link.trajectory(trajectory);
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 3;
}
