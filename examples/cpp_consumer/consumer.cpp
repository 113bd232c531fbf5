// Listens to the predictor and hands an MPC what it needs: the next state, and the coefficients as they are now.
//
// An MPC that plans with these coefficients takes all of a message or none, as they belong to one set. It holds them
// for as long as they may be old, and then goes back to its own. Their standard deviations are its margins.

#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <string>

#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>

class Consumer : public rclcpp::Node
{
public:
  Consumer() : Node("dynssm_consumer")
  {
    const auto qos = rclcpp::SensorDataQoS();
    predictions_ = create_subscription<nav_msgs::msg::Odometry>(
      "dynssm/prediction", qos, [this](const nav_msgs::msg::Odometry & message) {predicted(message);});
    parameters_ = create_subscription<sensor_msgs::msg::JointState>(
      "dynssm/parameters", qos, [this](const sensor_msgs::msg::JointState & message) {adapted(message);});
  }

  // A coefficient for the next plan: as it is now, or your own where nothing has come for half a second.
  double coefficient(const std::string & name, double own) const
  {
    const auto found = coefficients_.find(name);
    const bool fresh = (now() - newest_).seconds() < 0.5;
    return fresh && found != coefficients_.end() ? found->second : own;
  }

private:
  // The state one sampling time after the odometry that it answers; the stamp says when.
  void predicted(const nav_msgs::msg::Odometry & message)
  {
    const auto & twist = message.twist.twist;
    RCLCPP_INFO(
      get_logger(), "v_y %.3f +- %.3f m/s, yaw rate %.3f rad/s, front peak %.4g N", twist.linear.y,
      std::sqrt(message.twist.covariance[7]), twist.angular.z, coefficient("D_f", 0.192));
  }

  // Position is the coefficient, effort its standard deviation (empty if nothing follows it).
  void adapted(const sensor_msgs::msg::JointState & message)
  {
    const auto & value = message.position;
    const bool finite = std::all_of(value.begin(), value.end(), [](double v) {return std::isfinite(v);});
    if (!finite || value.size() != message.name.size()) {return;}
    for (size_t k = 0; k < value.size(); ++k) {coefficients_[message.name[k]] = value[k];}
    newest_ = now();
  }

  std::map<std::string, double> coefficients_;
  rclcpp::Time newest_{0, 0, RCL_ROS_TIME};
  rclcpp::Subscription<nav_msgs::msg::Odometry>::SharedPtr predictions_;
  rclcpp::Subscription<sensor_msgs::msg::JointState>::SharedPtr parameters_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Consumer>());
  rclcpp::shutdown();
}
