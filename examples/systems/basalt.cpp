// Basalt's visual-inertial odometry as an estimator of a run, by the native interface: a stereo rig
// with an IMU.
//
//     basalt FOLDER/calibration.json [CONFIG.json]   # as `calibration = "basalt"` writes it
//
// It answers with the pose and velocity of camera 0 in Basalt's world (z up). Its threads are kept
// in step: the next frame is read when the state of the one before has come out.
#include <basalt/calibration/calibration.hpp>
#include <basalt/serialization/headers_serialization.h>
#include <basalt/vi_estimator/vio_estimator.h>

#include <fstream>
#include <iostream>

#include "visnav_link.hpp"

namespace {

basalt::OpticalFlowInput::Ptr images_of(const visnav::Frame& frame, std::int64_t stamp) {
    auto found = std::make_shared<basalt::OpticalFlowInput>();
    found->t_ns = stamp;
    for (const visnav::Image& image : frame.images) {
        basalt::ImageData copy;
        copy.img.reset(new basalt::ManagedImage<std::uint16_t>(image.width, image.height));
        for (int v = 0; v < image.height; ++v)
            for (int u = 0; u < image.width; ++u)  // Basalt's images have 16 bits
                (*copy.img)(u, v) = static_cast<std::uint16_t>(image.row<std::uint8_t>(v)[u] << 8);
        found->img_data.push_back(copy);
    }
    return found;
}

void push(basalt::VioEstimatorBase& vio, std::int64_t stamp, const visnav::Imu& sample) {
    basalt::ImuData<double>::Ptr data(new basalt::ImuData<double>);
    data->t_ns = stamp;
    data->gyro = Eigen::Vector3d(sample.angular_velocity);
    data->accel = Eigen::Vector3d(sample.linear_acceleration);
    vio.imu_data_queue.push(data);
}

}  // namespace

int main(int count, char** words) try {
    if (count < 2) throw visnav::Error("expected an argument: the path of calibration.json");
    basalt::Calibration<double> calibration;
    std::ifstream file(words[1]);
    cereal::JSONInputArchive archive(file);
    archive(calibration);
    basalt::VioConfig config;
    if (count > 2) config.load(words[2]);
    config.vio_enforce_realtime = false;  // it would leave frames out

    auto flow = basalt::OpticalFlowFactory::getOpticalFlow(config, calibration);
    auto vio = basalt::VioEstimatorFactory::getVioEstimator(config, calibration,
                                                            {0.0, 0.0, -9.81}, true);
    tbb::concurrent_bounded_queue<basalt::PoseVelBiasState<double>::Ptr> states;
    vio->imu_data_queue.set_capacity(100000);  // a push beyond it would wait for ever
    vio->initialize(Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero());
    flow->output_queue = &vio->vision_data_queue;
    vio->out_state_queue = &states;

    {
        visnav::Link link("Basalt");
        link.ready();
        const Sophus::SE3d& mounted = calibration.T_i_c.at(0);
        visnav::Imu last{};
        while (const auto frame = link.next()) {
            const std::int64_t exposed = frame->stamp + calibration.cam_time_offset_ns;
            for (const visnav::Imu& sample : frame->rows<visnav::Imu>("imu"))
                push(*vio, (last = sample).stamp, sample);
            // It waits for a sample of after the exposure, which comes with the next frame only.
            if (last.stamp <= exposed) push(*vio, exposed + 1, last);
            flow->input_queue.push(images_of(*frame, exposed));
            basalt::PoseVelBiasState<double>::Ptr state;
            states.pop(state);
            if (!state) throw visnav::Error("Basalt has ended");
            const Sophus::SE3d camera = state->T_w_i * mounted;
            const Eigen::Vector3d turn_rate =
                state->T_w_i.so3() * (Eigen::Vector3d(last.angular_velocity) - state->bias_gyro);
            const Eigen::Vector3d velocity =
                state->vel_w_i + turn_rate.cross(camera.translation() - state->T_w_i.translation());
            visnav::Pose pose;
            Eigen::Map<Eigen::Matrix<double, 3, 4, Eigen::RowMajor>>(pose.matrix.data()) =
                camera.matrix3x4();
            link.pose(*frame, pose, visnav::Link::Status::tracked, {}, {}, nullptr,
                      velocity.data());
        }
    }
    flow->input_queue.push(nullptr);  // ends its threads
    vio->imu_data_queue.push(nullptr);
    for (basalt::PoseVelBiasState<double>::Ptr state;; ) {
        states.pop(state);
        if (!state) break;
    }
} catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    std::_Exit(1);  // not past Basalt's threads, which wait
}
