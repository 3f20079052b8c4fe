// OpenVINS as an estimator of a run: one to several cameras and an IMU, by the native interface.
//
//     openvins FOLDER/estimator_config.yaml      # as `calibration = "openvins"` writes it
//
// It answers with the pose of camera 0 in OpenVINS's own world (z up), its covariance and its
// velocity, all computed from the IMU's. One thread computes, one frame after the other, so that the
// answers depend on what was sent alone.
#include <core/VioManager.h>
#include <state/State.h>
#include <state/StateHelper.h>

#include <Eigen/Geometry>
#include <iostream>
#include <opencv2/core.hpp>

#include "visnav_link.hpp"

namespace {

using Matrix3 = Eigen::Matrix3d;
using Row6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;

constexpr double seconds = 1e-9;  // of a nanosecond

ov_core::CameraData images_of(const visnav::Frame& frame) {
    ov_core::CameraData found;
    found.timestamp = seconds * frame.stamp;
    for (const visnav::Image& image : frame.images) {
        // A copy: OpenVINS keeps images beyond the answer, when the run writes others there.
        const cv::Mat shared(image.height, image.width, CV_8UC1,
                             const_cast<std::uint8_t*>(image.data), image.stride);
        found.sensor_ids.push_back(static_cast<int>(image.camera));
        found.images.push_back(shared.clone());
        found.masks.push_back(cv::Mat::zeros(shared.size(), CV_8UC1));
    }
    return found;
}

// Turn a state of the IMU into an answer: pose, covariance and velocity of camera 0.
void answer(visnav::Link& link, const visnav::Frame& frame,
            const std::shared_ptr<ov_msckf::State>& state, const Eigen::Vector3d& turn_rate) {
    const Matrix3 imu = state->_imu->Rot().transpose();  // JPL's quaternion is of world to IMU
    const auto& mounted = state->_calib_IMUtoCAM.at(0);
    const Matrix3 camera = imu * mounted->Rot().transpose();
    const Eigen::Vector3d lever = -camera * mounted->pos();  // from IMU to camera, in the world
    const Eigen::Vector3d at = state->_imu->pos() + lever;
    visnav::Pose pose;
    Eigen::Map<Eigen::Matrix<double, 3, 4, Eigen::RowMajor>>(pose.matrix.data()) << camera, at;

    // OpenVINS's error is (rotation about the IMU's axes, position): the rotation is turned into
    // the world, where it also shifts the camera by its lever.
    Eigen::Matrix<double, 6, 6> moved = Eigen::Matrix<double, 6, 6>::Zero();
    moved.topRightCorner<3, 3>().setIdentity();
    moved.bottomLeftCorner<3, 3>() = imu;
    moved.topLeftCorner<3, 3>() = -ov_core::skew_x(lever) * imu;
    const Eigen::MatrixXd own =
        ov_msckf::StateHelper::get_marginal_covariance(state, {state->_imu->pose()});
    const Row6 covariance = moved * own * moved.transpose();
    const Eigen::Vector3d velocity =
        state->_imu->vel() + (imu * (turn_rate - state->_imu->bias_g())).cross(lever);
    link.pose(frame, pose, visnav::Link::Status::tracked, {}, {}, covariance.data(),
              velocity.data());
}

}  // namespace

int main(int count, char** words) try {
    if (count != 2) throw visnav::Error("expected one argument: the path of estimator_config.yaml");
    ov_core::Printer::current_print_level = ov_core::Printer::PrintLevel::INFO;
    ov_msckf::VioManagerOptions options;
    options.print_and_load(std::make_shared<ov_core::YamlParser>(words[1]));
    options.use_multi_threading_subs = false;  // else a thread decides when it has initialized
    options.num_opencv_threads = 1;
    ov_msckf::VioManager vio(options);

    visnav::Link link("OpenVINS");
    link.ready();
    Eigen::Vector3d turn_rate = Eigen::Vector3d::Zero();
    while (const auto frame = link.next()) {
        for (const visnav::Imu& sample : frame->rows<visnav::Imu>("imu")) {
            turn_rate = Eigen::Vector3d(sample.angular_velocity);
            vio.feed_measurement_imu({seconds * sample.stamp, turn_rate,
                                      Eigen::Vector3d(sample.linear_acceleration)});
        }
        const ov_core::CameraData images = images_of(*frame);
        vio.feed_measurement_camera(images);
        // Not initialized(): it is false until OpenVINS has moved, which a pilot that flies by its
        // estimates would wait for in vain.
        if (vio.initialized_time() < 0) {
            link.initialising(*frame);
            continue;
        }
        // From now on it would print several lines a frame.
        ov_core::Printer::current_print_level = ov_core::Printer::PrintLevel::ERROR;
        if (vio.get_state()->_timestamp != images.timestamp)
            link.lost(*frame);
        else
            answer(link, *frame, vio.get_state(), turn_rate);
    }
} catch (const std::exception& error) {
    std::cerr << error.what() << '\n';
    return 1;
}
