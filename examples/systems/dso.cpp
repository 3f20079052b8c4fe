// DSO, direct sparse odometry, as an estimator of a run with a single camera, by the native interface.
//
// It answers with the pose of the camera in DSO's world, whose unit of length is arbitrary, and at the end
// gives those of the keyframes after all optimizations, which DSO itself writes as its result. All is
// computed in the caller's thread, one frame after the other. Images of a lens are rectified.
//
// The argument is DSO's own: `mode=2`, if there is none, takes images as perfect (one exposure, no
// vignette, little noise); `mode=1` is for cameras without photometric calibration, as EuRoC's, and
// estimates the brightness of each frame.
#define BOOST_BIND_GLOBAL_PLACEHOLDERS  // which DSO's headers use
#include <boost/bind.hpp>

#include <FullSystem/FullSystem.h>
#include <FullSystem/HessianBlocks.h>
#include <IOWrapper/Output3DWrapper.h>
#include <util/FrameShell.h>
#include <util/ImageAndExposure.h>
#include <util/globalCalib.h>
#include <util/settings.h>

#include <algorithm>
#include <array>
#include <iostream>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "visnav_link.hpp"

namespace {

// Keyframes until DSO no longer takes its initialization back, as it may, and begins anew.
constexpr int sure = 4;

visnav::Pose pose_of(const dso::FrameShell& frame) {
    visnav::Pose pose;
    Eigen::Map<Eigen::Matrix<double, 3, 4, Eigen::RowMajor>>(pose.matrix.data()) =
        frame.camToWorld.matrix3x4();
    return pose;
}

// Keeps what DSO says of the frame that it gets, whose pose changes until the frame is done, and the
// keyframes' poses, which change until they leave DSO's window.
struct Output : dso::IOWrap::Output3DWrapper {
    dso::FrameShell* frame = nullptr;
    int keyframes = 0;
    std::map<int, visnav::Pose> trajectory;  // by the number of the frame

    void publishCamPose(dso::FrameShell* tracked, dso::CalibHessian*) override { frame = tracked; }
    void publishKeyframes(std::vector<dso::FrameHessian*>& frames, bool final,
                          dso::CalibHessian*) override {
        for (const dso::FrameHessian* keyframe : frames)
            trajectory[keyframe->shell->incoming_id] = pose_of(*keyframe->shell);
        if (final) return;
        frame = frames.back()->shell;
        ++keyframes;
    }
};

struct System {
    Output output;
    dso::FullSystem full;

    System() {
        full.setGammaFunction(nullptr);
        full.linearizeOperation = true;  // else a thread of its own decides what is a keyframe
        full.outputWrapper.push_back(&output);
    }
    EIGEN_MAKE_ALIGNED_OPERATOR_NEW
};

// Makes pinhole images of those of a radial-tangential lens, with the same matrix, as DSO's own tools do
// before it sees an image: what the calibration errs by stays in them.
class Rectification {
public:
    explicit Rectification(const visnav::Camera& camera)
        : width_(camera.width), height_(camera.height) {
        if (camera.distortion_model != "plumb_bob")
            throw visnav::Error("expected the lens plumb_bob, found " + camera.distortion_model);
        std::array<double, 5> k{};
        std::copy_n(camera.distortion.begin(), std::min<std::size_t>(k.size(), camera.distortion.size()), k.begin());
        for (int v = 0; v < height_; ++v)
            for (int u = 0; u < width_; ++u) {
                const double x = (u - camera.cx) / camera.fx, y = (v - camera.cy) / camera.fy;
                const double r2 = x * x + y * y, radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
                const double at_x = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x);
                const double at_y = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y;
                places_.push_back({inside(camera.fx * at_x + camera.cx, width_),
                                   inside(camera.fy * at_y + camera.cy, height_)});
            }
    }
    // Bilinear; what lies beyond the image's edge is its edge.
    void rectify(const visnav::Image& from, float* to) const {
        for (const auto& [u, v] : places_) {
            const int column = static_cast<int>(u), row = static_cast<int>(v);
            const float across = u - float(column), down = v - float(row);
            const std::uint8_t *above = from.row<std::uint8_t>(row) + column,
                               *below = from.row<std::uint8_t>(row + 1) + column;
            *to++ = (1 - down) * ((1 - across) * above[0] + across * above[1]) +
                    down * ((1 - across) * below[0] + across * below[1]);
        }
    }

private:
    static float inside(double at, int size) {
        return static_cast<float>(std::min(std::max(at, 0.0), size - 1.001));
    }
    int width_, height_;
    std::vector<std::array<float, 2>> places_;
};

void configure(const visnav::Camera& camera, bool perfect) {
    dso::setting_photometricCalibration = 0;
    dso::setting_affineOptModeA = dso::setting_affineOptModeB = perfect ? -1 : 0;
    if (perfect) dso::setting_minGradHistAdd = 3;
    dso::multiThreading = false;
    dso::disableAllDisplay = true;
    dso::setting_logStuff = false;
    dso::setting_debugout_runquiet = true;
    Eigen::Matrix3f matrix;
    matrix << float(camera.fx), 0, float(camera.cx), 0, float(camera.fy), float(camera.cy), 0, 0, 1;
    dso::setGlobalCalib(camera.width, camera.height, matrix);
}

}  // namespace

int main(int argc, char** argv) try {
    const std::string mode = argc > 1 ? argv[1] : "mode=2";
    if (argc > 2 || (mode != "mode=1" && mode != "mode=2"))
        throw visnav::Error("expected mode=1, mode=2 or no argument, found " + mode);
    visnav::Link link("DSO");
    const visnav::Camera camera = link.camera(0);
    configure(camera, mode == "mode=2");
    const Rectification rectification(camera);
    auto system = std::make_unique<System>();
    dso::ImageAndExposure image(camera.width, camera.height);
    link.ready(visnav::Link::PoseOf::camera, true);
    std::vector<std::int64_t> stamps;  // by the number of the frame
    while (const auto frame = link.next()) {
        rectification.rectify(frame->image("mono8"), image.image);
        image.timestamp = 1e-9 * frame->stamp;
        const int number = static_cast<int>(frame->sequence);
        system->full.addActiveFrame(&image, number);

        stamps.push_back(frame->stamp);
        const Output& output = system->output;
        const bool begun = output.keyframes >= sure;
        if (!begun && (system->full.initFailed || system->full.isLost)) {
            link.initialising(*frame);
            system = std::make_unique<System>();
        } else if (!begun) {
            link.initialising(*frame);
        } else if (system->full.isLost || output.frame->incoming_id != number) {
            link.lost(*frame);  // for good: DSO does not relocalize
        } else {
            link.pose(*frame, pose_of(*output.frame));
        }
    }
    std::vector<visnav::StampedPose> trajectory;
    for (const auto& [number, pose] : system->output.trajectory)
        trajectory.push_back({stamps.at(static_cast<std::size_t>(number)), pose});
    link.trajectory(trajectory);
} catch (const std::exception& error) {
    std::cerr << error.what() << '\n';
    return 1;
}
