"""Kalibr's files as published: TUM VI's (vision.in.tum.de/data/datasets/visual-inertial-dataset).

``camchain.yaml`` and ``imu_config.yaml`` of its sequences of 512 × 512 pixels (T_cn_cnm1: from both
T_cam_imu, with fewer digits).
"""

CHAIN = """\
cam0:
  T_cam_imu:
  - [-0.9995378259923383, 0.02917807204183088, -0.008530798463872679, 0.047094247958417004]
  - [0.007526588843243184, -0.03435493139706542, -0.9993813532126198, -0.04788273017221637]
  - [-0.029453096117288798, -0.9989836729399656, 0.034119442089241274, -0.0697294754693238]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202,
    0.00020293673591811182]
  distortion_model: equidistant
  intrinsics: [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504]
  resolution: [512, 512]
  rostopic: /cam0/image_raw
cam1:
  T_cam_imu:
  - [-0.9995240747493029, 0.02986739485347808, -0.007717688852024281, -0.05374086123613335]
  - [0.008095979457928231, 0.01256553460985914, -0.9998882749870535, -0.04648588412432889]
  - [-0.02976708103202316, -0.9994748851595197, -0.0128013601698453, -0.07333210787623645]
  - [0.0, 0.0, 0.0, 1.0]
  T_cn_cnm1:
  - [0.999999432, -0.000836184722, -0.000661284405, -0.100921232]
  - [0.000804245728, 0.998898944, -0.0469068457, -0.0019645406]
  - [0.000699779081, 0.0469062872, 0.998899049, -0.0014663556]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.0034003170790442797, 0.001766278153469831, -0.00266312569781606,
    0.0003299517423931039]
  distortion_model: equidistant
  intrinsics: [190.44236969414825, 190.4344384721956, 252.59949716835982, 254.91723064636983]
  resolution: [512, 512]
  rostopic: /cam1/image_raw
"""

IMU = """\
#Accelerometers
accelerometer_noise_density: 0.0014     # m/s^2/sqrt(Hz)
accelerometer_random_walk:   0.000086   # m/s^3/sqrt(Hz)

#Gyroscopes
gyroscope_noise_density:     8.0e-5     # rad/s/sqrt(Hz)
gyroscope_random_walk:       2.2e-06    # rad/s^2/sqrt(Hz)

rostopic:                    /imu0
update_rate:                 200.0      # Hz
"""

IN_IMU = (0.04537913, -0.07267773, -0.04507223)
"""Where the first camera is on the IMU, metres: -Rᵀ t of its T_cam_imu."""
