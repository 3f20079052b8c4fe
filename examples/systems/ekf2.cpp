// EKF2, the filter of PX4's autopilot, as an estimator of a run, by the native interface: `ekf2 NODE`
// fuses the IMU, the barometer, and that node's estimates as external vision.
// EKF2_EV_DELAY, milliseconds, is PX4's parameter: how old a pose is at its stamp ("measured": as the
// first one is). EKF2_STAMPS: at "arrival", as without a common clock, or at "exposure". EKF2_VELOCITY: 1
// fuses velocities, too. It answers with the body's pose of now, at the IMU's last sample. Other settings
// are the library's, least variances those of PX4's module around it.
#include <EKF/ekf.h>
#include <iostream>
#include "visnav_link.hpp"

namespace {
using Vector = matrix::Vector3f;

std::uint64_t micro(std::int64_t stamp) {  // never 0: EKF2 takes that for "no measurement"
    return static_cast<std::uint64_t>(stamp / 1000 + 1000000);
}
Vector vector(const double* v) { return {float(v[0]), float(v[1]), float(v[2])}; }
float altitude(double pressure) {  // of the standard atmosphere
    return float(44330.8 * (1.0 - std::pow(pressure / 101325.0, 0.190263)));
}

std::string variable(const char* name) { return std::getenv(name) ? std::getenv(name) : ""; }

extVisionSample vision_of(const visnav::PoseEstimate& estimate, std::int64_t stamp) {
    extVisionSample found;
    matrix::Dcmf turn;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) turn(i, j) = float(estimate.pose[4 * i + j]);
        found.pos(i) = float(estimate.pose[4 * i + 3]);
        const double variance = estimate.covariance[7 * i];  // NaN if unknown: then the least
        found.posVar(i) = variance > 0.01 ? float(variance) : 0.01f;
    }
    found.time_us = micro(stamp);
    found.quat = matrix::Quatf(turn);
    found.angVar = estimate.covariance[35] > 0.0025 ? float(estimate.covariance[35]) : 0.0025f;
    found.vel = vector(estimate.velocity);
    found.velCov = matrix::eye<float, 3>() * 0.01f;
    found.vel_frame = velocity_frame_t::LOCAL_FRAME_FRD;
    return found;
}

void answer(visnav::Link& link, const visnav::Frame& frame, const Ekf& ekf) {
    const matrix::Quatf q = ekf.getQuaternion();
    const Vector at = ekf.getPosition(), speed = ekf.getVelocity();
    const auto pose = visnav::Pose::from_quaternion(at(0), at(1), at(2), q(1), q(2), q(3), q(0));
    // Its error of (quaternion, velocity, position, …) as that of a shift and a rotation.
    matrix::Matrix<float, 6, 24> moved;
    const float turn[3][4] = {
        {-q(1), q(0), -q(3), q(2)}, {-q(2), q(3), q(0), -q(1)}, {-q(3), -q(2), q(1), q(0)}};
    for (int i = 0; i < 3; ++i) {
        moved(i, 7 + i) = 1.0f;
        for (int j = 0; j < 4; ++j) moved(3 + i, j) = 2.0f * turn[i][j];
    }
    const auto spread = moved * ekf.covariances() * moved.transpose();
    double covariance[36];
    for (int i = 0; i < 36; ++i)
        covariance[i] = 0.5 * (double(spread(i / 6, i % 6)) + double(spread(i % 6, i / 6)));
    const double velocity[] = {speed(0), speed(1), speed(2)};
    link.pose(frame, pose, visnav::Link::Status::tracked, {}, {}, covariance, velocity);
}

}  // namespace

int main(int count, char** words) try {
    if (count != 2) throw visnav::Error("expected the name of a node");
    const std::string vio = words[1];
    const std::string delay = variable("EKF2_EV_DELAY");
    const bool velocity = variable("EKF2_VELOCITY") == "1";
    const bool exposed = variable("EKF2_STAMPS") == "exposure";
    Ekf ekf;
    parameters& settings = *ekf.getParamHandle();
    settings.fusion_mode = MASK_USE_EVPOS | MASK_USE_EVYAW | (velocity ? MASK_USE_EVVEL : 0);
    settings.vdist_sensor_type = VDIST_SENSOR_EV;
    settings.mag_fusion_type = MAG_FUSE_TYPE_NONE;
    bool timed = !delay.empty() && delay != "measured";
    if (timed) settings.ev_delay_ms = std::stof(delay);

    visnav::Link link("EKF2");
    link.ready(visnav::Link::PoseOf::body);
    std::int64_t last = 0, begun = 0;
    bool flying = false;
    while (const auto frame = link.next()) {
        for (const visnav::Input& input : frame->inputs) {  // as they came
            if (!timed && input.name == vio && !input.bytes.empty()) {
                timed = true;  // its buffers are as long as this age when it begins
                settings.ev_delay_ms = 1e-6f * float(input.arrived - input.rows<visnav::PoseEstimate>()[0].stamp);
            }
            if (!timed) continue;
            if (input.kind == visnav::Imu::kind)
                for (const visnav::Imu& imu : input.rows<visnav::Imu>()) {
                    const float dt = last ? 1e-9f * float(imu.stamp - last) : 0.005f;
                    last = imu.stamp;
                    ekf.set_in_air_status(flying);
                    ekf.setIMUData({micro(imu.stamp), vector(imu.angular_velocity) * dt,
                                    vector(imu.linear_acceleration) * dt, dt, dt});
                    ekf.update();
                }
            else if (input.kind == visnav::FluidPressure::kind)
                for (const visnav::FluidPressure& air : input.rows<visnav::FluidPressure>())
                    ekf.setBaroData({micro(air.stamp), altitude(air.fluid_pressure)});
            else if (input.name == vio)
                for (const visnav::PoseEstimate& estimate : input.rows<visnav::PoseEstimate>())
                    if (std::isfinite(estimate.pose[3])) {
                        flying = estimate.pose[11] < -0.2;  // metres down
                        ekf.setExtVisionData(vision_of(estimate, exposed ? estimate.stamp : input.arrived));
                    }
        }
        if (!begun && ekf.attitude_valid() && ekf.control_status_flags().ev_pos) begun = frame->stamp;
        if (!begun || frame->stamp < begun + 1000000000)  // its height settles within a second
            link.initialising(*frame);
        else if (ekf.inertial_dead_reckoning())
            link.lost(*frame);
        else
            answer(link, *frame, ekf);
    }
} catch (const std::exception& error) {
    std::cerr << error.what() << '\n';
    return 1;
}
